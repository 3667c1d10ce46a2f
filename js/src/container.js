/** The file as sections: header, metadata, parameters, pages, payloads (FORMAT.md §3, §4). */

import { crc32 } from "./bytes.js";
import { require, requireKnown } from "./errors.js";
import { Grid, nameOf } from "./grid.js";
import { HEADER_SIZE, readHeader } from "./header.js";
import { readMetadata } from "./metadata.js";
import { Segment, headOfKey, parentOfHead } from "./segment.js";
import { readRanges } from "./source.js";

/** Most files are opened by one request of so many bytes (§10). */
const FIRST_READ = 16384;
const HAVE_PARAMETERS = ["predictive", "rapid"];
const MOST_SEGMENTS = 512;
/** Where no more segments are needed at once, payloads behind their pages are too. */
const FEW_SEGMENTS = 8;
const TOP = "top";

export class Container {
  /** Open a file in at most two reads. */
  static async open(source) {
    let start = await source.head(FIRST_READ);
    const header = readHeader(start, source.size);
    const parametersAt = HEADER_SIZE + header.metadataLength;
    const pageAt = parametersAt + header.parametersLength;
    const end = pageAt + header.topPageLength;
    if (start.length < end) {
      const rest = await source.read(start.length, end);
      const both = new Uint8Array(end);
      both.set(start);
      both.set(rest, start.length);
      start = both;
    }
    const container = new Container();
    container.source = source;
    container.header = header;
    container.start = start.slice(0, HEADER_SIZE);
    container.metadata = readMetadata(start.subarray(HEADER_SIZE, parametersAt), header);
    container.parameters = start.slice(parametersAt, pageAt);
    require(crc32(container.parameters) === header.parametersCrc, "parameters_crc");
    requireKnown(header.parametersLength === 0 || HAVE_PARAMETERS.includes(header.method),
      `parameters of method ${header.method}`);
    container.grid = new Grid(header);
    const place = { start: pageAt, end: null, siblingsEnd: 0 };
    const page = start.subarray(pageAt, end);
    const top = new Segment(container.grid, null, place, page, header.fileSize);
    container.segments = new Map([[TOP, top]]);
    return container;
  }

  /** Return the segments of heads (null: the top one), reading pages that are missing. */
  async segmentsOf(heads) {
    const found = new Map();
    const missing = new Map();
    for (const head of heads) {
      const name = head === null ? TOP : nameOf(head);
      const known = this.segments.get(name);
      if (known) found.set(name, known);
      else missing.set(name, head);
    }
    if (missing.size === 0) return found;
    const parents = [...missing.values()].map((head) => parentOfHead(this.grid, head));
    const above = await this.segmentsOf(parents);
    const names = [...missing.keys()];
    const places = names.map((name, i) =>
      above.get(parents[i] === null ? TOP : nameOf(parents[i])).children.get(name),
    );
    const ranges = places.map((place) =>
      place ? [place.start, place.start + place.pageLength] : [0, 0],
    );
    if (missing.size <= FEW_SEGMENTS) {
      for (const place of places) if (place) this.source.announce?.(place.start, place.end);
    }
    const pages = await readRanges(this.source, ranges);
    names.forEach((name, i) => {
      const head = missing.get(name);
      found.set(name, new Segment(this.grid, head, places[i], pages[i], this.header.fileSize));
      this.keep(name, found.get(name));
    });
    return found;
  }

  keep(name, segment) {
    this.segments.set(name, segment);
    for (const oldest of this.segments.keys()) {
      if (this.segments.size <= MOST_SEGMENTS) break;
      if (oldest !== TOP) this.segments.delete(oldest);
    }
  }

  async segmentsByKey(keys) {
    const heads = keys.map((key) => headOfKey(this.grid, key));
    const segments = await this.segmentsOf(heads);
    return heads.map((head) => segments.get(head === null ? TOP : nameOf(head)));
  }

  /** Return the payloads of keys, in their order, checked. */
  async payloads(keys) {
    const segments = await this.segmentsByKey(keys);
    const places = keys.map((key, i) => segments[i].payloads.get(nameOf(key)));
    const found = await readRanges(this.source, places.map(({ start, end }) => [start, end]));
    found.forEach((payload, i) => {
      require(crc32(payload) === places[i].crc, `checksum of payload ${nameOf(keys[i])}`);
    });
    return found;
  }

  /** Return the code of a block's error (§4.4). */
  async errorCode(block) {
    const [segment] = await this.segmentsByKey([this.grid.keyOfBlock(block)]);
    return segment.errors.get(nameOf(block));
  }
}
