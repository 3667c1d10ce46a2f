/** Metadata: strict JSON, deflated with a dictionary (FORMAT.md §4.2). */

import { crc32 } from "./bytes.js";
import { DICTIONARY } from "./dictionary.js";
import { CorruptStreamError, require } from "./errors.js";
import { inflateRaw } from "./inflate.js";

const LIMIT = 2 ** 20;
const DEEPEST = 16;
const NUMBER = /-?(?:0|[1-9]\d*)(?:\.\d+)?(?:[eE][+-]?\d+)?/y;
const STRING = /"(?:[^"\\\u0000-\u001f]|\\(?:["\\/bfnrt]|u[0-9a-fA-F]{4}))*"/y;
const SPACE = /[ \t\n\r]*/y;
/** With the flag u pairs are one character, and not matched. */
const LONE_SURROGATE = /[\ud800-\udfff]/u;

/** JSON.parse would take keys twice, infinite numbers, lone surrogates and any depth. */
class Parser {
  constructor(text) {
    this.text = text;
    this.at = 0;
  }

  /** Return what a sticky expression matches here, or null. */
  match(expression) {
    expression.lastIndex = this.at;
    const found = expression.exec(this.text);
    if (found === null) return null;
    this.at = expression.lastIndex;
    return found[0];
  }

  /** Skip white space and return the next character. */
  peek() {
    this.match(SPACE);
    return this.text[this.at];
  }

  take(character) {
    require(this.peek() === character, `metadata: no ${character} at ${this.at}`);
    this.at++;
  }

  string() {
    this.match(SPACE);
    const found = this.match(STRING);
    require(found !== null, `metadata: no string at ${this.at}`);
    const text = JSON.parse(found);
    require(!LONE_SURROGATE.test(text), "metadata: a lone surrogate");
    return text;
  }

  number() {
    const text = this.match(NUMBER);
    require(text !== null, `metadata: no value at ${this.at}`);
    const value = Number(text);
    require(Number.isFinite(value), "metadata: a number that is not finite");
    // Integers beyond ±2^64 are told apart from all that §4.2 allows.
    if (/^-?\d+$/.test(text) && Math.abs(value) >= 2 ** 64) {
      const exact = BigInt(text);
      if (exact > 2n ** 64n || exact < -(2n ** 64n)) return exact;
    }
    return value;
  }

  /** Read members until `end`, calling `one` for each. */
  list(end, one) {
    this.at++;
    if (this.peek() === end) {
      this.at++;
      return;
    }
    for (;;) {
      one();
      if (this.peek() === end) break;
      this.take(",");
    }
    this.at++;
  }

  value(depth) {
    const first = this.peek();
    if (first === "{" || first === "[") {
      require(depth < DEEPEST, "metadata is nested too deep");
      if (first === "[") {
        const values = [];
        this.list("]", () => values.push(this.value(depth + 1)));
        return values;
      }
      const members = new Map();
      this.list("}", () => {
        const key = this.string();
        require(!members.has(key), `metadata: the key ${key} occurs twice`);
        this.take(":");
        members.set(key, this.value(depth + 1));
      });
      return Object.fromEntries(members); // defines "__proto__" as a key like any other
    }
    if (first === '"') return this.string();
    for (const [word, value] of [["true", true], ["false", false], ["null", null]]) {
      if (this.text.startsWith(word, this.at)) {
        this.at += word.length;
        return value;
      }
    }
    return this.number();
  }

  all() {
    const value = this.value(0);
    require(this.peek() === undefined, "metadata: text after the object");
    return value;
  }
}

const isNumber = (value) => typeof value === "number";
const isString = (value) => typeof value === "string";
const isObject = (value) => typeof value === "object" && value !== null && !Array.isArray(value);
const isTexts = (value) => isObject(value) && Object.values(value).every(isString);
const isOneOf = (...values) => (value) => values.includes(value);

const KINDS = {
  crs: isString,
  transform: (value) => Array.isArray(value) && value.length === 6 && value.every(isNumber),
  mask_kind: isOneOf("none", "nodata", "nan", "mask"),
  units: isString,
  scale: (value) => isNumber(value) && value !== 0,
  offset: isNumber,
  area_or_point: isOneOf("Area", "Point"),
  description: isString,
  tags: isTexts,
  band_tags: isTexts,
  color_interpretation: isString,
  moved: (value) => Number.isInteger(value) && value >= 0 && value <= 2 ** 31,
  software: isString,
};

function isNodata(value, dtype) {
  if (["nan", "inf", "-inf"].includes(value)) return dtype.range === null;
  if (!isNumber(value)) return false;
  if (dtype.range === null) return dtype.name === "float64" || Number.isFinite(Math.fround(value));
  return Number.isInteger(value) && value >= dtype.range[0] && value <= dtype.range[1];
}

/** Return the metadata, without keys that are null. */
export function readMetadata(section, header) {
  require(crc32(section) === header.metadataCrc, "metadata_crc");
  const bytes = inflateRaw(section, LIMIT, DICTIONARY);
  let text;
  try {
    text = new TextDecoder("utf-8", { fatal: true, ignoreBOM: true }).decode(bytes);
  } catch (cause) {
    throw new CorruptStreamError("metadata is not UTF-8", { cause });
  }
  const all = new Parser(text).all();
  require(isObject(all), "metadata is not an object");
  const metadata = Object.fromEntries(Object.entries(all).filter(([, value]) => value !== null));
  for (const [key, isRight] of Object.entries(KINDS)) {
    require(!Object.hasOwn(metadata, key) || isRight(metadata[key]), `metadata: ${key}`);
  }
  require(!Object.hasOwn(metadata, "nodata") || isNodata(metadata.nodata, header.dtype),
    "metadata: nodata");
  return metadata;
}
