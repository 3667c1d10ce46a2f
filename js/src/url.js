/**
 * A file on a web server, by range requests. What is asked for again, after which waits, and what
 * errors say is the same as in Python: docs/how-to/remote.md. A table of cases holds both to it.
 */

import { ArgumentError, LimitExceededError, SourceError } from "./errors.js";

/** A file of a server that sends no ranges is taken whole up to so many bytes, as by Python. */
export const MOST_WHOLE = 1 << 26;

/** Seconds, and statuses of servers that may have time later. */
export const POLICY = {
  busy: [408, 425, 429, 500, 502, 503, 504],
  delays: [0.2, 1], // before a busy server, or one that hung up, is asked again
  longestWait: 10, // where Retry-After asks for more
  silence: 30, // without a byte
  leastRate: 1024, // bytes a second, of each reply; so long more than `silence` it may take
  wait: (seconds) => new Promise((resolve) => setTimeout(resolve, seconds * 1000)),
};

/** Refusals that may mean that a signature has expired, and how much of their words is looked at. */
const MAY_EXPIRE = [400, 401, 403];
const MOST_WORDS = 4096;
const SIGNATURES = ["x-amz-signature", "x-goog-signature", "signature", "sig"];
const TELLS_EXPIRY = /expired|not valid in the specified time frame/i;
/** Codes of Node for servers that asking again does not help with; browsers have none. */
const LASTING = /^(ENOTFOUND|EAI_|ECONNREFUSED|CERT_|ERR_TLS|DEPTH_ZERO|SELF_SIGNED|UNABLE_TO)/;

export class UrlSource {
  constructor(url, { fetch = globalThis.fetch, headers = {}, signal } = {}) {
    if (typeof fetch !== "function") throw new ArgumentError("there is no fetch here: pass one");
    const { address, login } = addressOf(String(url));
    this.url = address;
    this.name = displayName(address);
    this.fetch = fetch;
    this.headers = { ...(login && { Authorization: login }), ...headers };
    this.signal = signal;
    this.size = null;
    this.version = { etag: null, modified: null };
    this.whole = null; // of a server that knows no ranges
  }

  async head(n) {
    const bytes = await this.part(0, n);
    return bytes.subarray(0, n);
  }

  async read(start, end) {
    const bytes = await this.part(start, end);
    if (bytes.length !== end - start) {
      throw new SourceError(
        `${this.name} ends at byte ${start + bytes.length}; ${end - start} bytes were expected at` +
        ` byte ${start}`,
      );
    }
    return bytes;
  }

  /** Return the bytes start ... end - 1 that exist; sets `size` the first time. */
  async part(start, end) {
    if (this.whole) return this.whole.subarray(start, end);
    let reply = await this.ask(start, end);
    let range = contentRange(reply);
    if (reply.status === 416 && this.size === null) {
      if (range?.size === 0) return this.take(new Uint8Array(0), reply);
      reply = await this.ask(null); // it does not cut ranges at the end of the file
      range = contentRange(reply);
    } else if (reply.status === 416 && range && range.size !== this.size) throw this.changed();
    if (reply.status === 200) {
      if (this.size !== null || !reply.body) throw this.withoutRanges();
      return this.take(reply.body, reply).subarray(start, end);
    }
    if (reply.status !== 206) throw this.refused(reply);
    if (reply.coding) {
      throw new SourceError(
        `${this.name}: the server sends parts of a compressed file (Content-Encoding: ` +
        `${reply.coding}), which nobody can read; store the file there without it`,
      );
    }
    if (range?.first === undefined) {
      throw new SourceError(reply.hidesRange
        ? `${this.name}: the server does not show pages of other origins which part it sent; let it` +
          " send the header Access-Control-Expose-Headers: Content-Range"
        : `${this.name}: no usable Content-Range in the server's reply`);
    }
    if ((this.size ?? range.size) !== range.size || !isSame(this.version, reply.version)) {
      throw this.changed();
    }
    const last = Math.min(end, range.size) - 1;
    if (range.first !== start || range.last !== last) {
      throw new SourceError(`${this.name}: the server sent ${range.text} for bytes ${start}-${last}`);
    }
    this.learn(range.size, reply.version);
    return reply.body;
  }

  /** Take the whole file from a server that sends no parts. */
  take(body, { version }) {
    if (!isSame(this.version, version)) throw this.changed();
    this.learn(body.length, version);
    this.whole = body;
    return body;
  }

  learn(size, { etag, modified }) {
    this.size = size;
    this.version = { etag: this.version.etag ?? etag, modified: this.version.modified ?? modified };
  }

  /** Return the first reply that is no sign of a busy server. */
  async ask(start, end) {
    for (let attempt = 0; ; attempt++) {
      const delay = POLICY.delays[attempt];
      let wait = delay;
      try {
        const reply = await this.askOnce(start, end);
        if (!POLICY.busy.includes(reply.status) || delay === undefined) return reply;
        wait = Math.max(delay, Math.min(reply.asksToWait, POLICY.longestWait));
      } catch (cause) {
        if (cause instanceof LimitExceededError || cause instanceof SourceError) throw cause;
        this.signal?.throwIfAborted();
        const { message, code = "" } = cause.cause ?? cause;
        if (delay === undefined || LASTING.test(code)) {
          throw new SourceError(`cannot read ${this.name}: ${message || code}`, { cause });
        }
      }
      await this.pause(wait);
    }
  }

  async pause(seconds) {
    const { signal } = this;
    let stop;
    const aborted = new Promise((_, reject) => {
      stop = () => reject(signal.reason);
      signal?.addEventListener("abort", stop);
    });
    try {
      await Promise.race([POLICY.wait(seconds), aborted]);
    } finally {
      signal?.removeEventListener("abort", stop);
    }
  }

  async askOnce(start, end) {
    const headers = { ...this.headers };
    if (start !== null) headers.Range = `bytes=${start}-${end - 1}`;
    const controller = new AbortController();
    const stop = () => controller.abort(this.signal.reason);
    if (this.signal?.aborted) stop();
    this.signal?.addEventListener("abort", stop);
    const wanted = start === null ? 0 : end - start;
    const most = wanted || MOST_WHOLE;
    const limit = POLICY.silence + most / POLICY.leastRate;
    const deadline = setTimeout(() => controller.abort(this.tooSlow(most, limit)), limit * 1000);
    let timer;
    const hear = () => {
      clearTimeout(timer);
      timer = setTimeout(() => controller.abort(new Error("timed out")), POLICY.silence * 1000);
    };
    try {
      hear();
      const { fetch } = this; // called unbound: browsers' fetch refuses another `this`
      const response = await fetch(this.url, { headers, signal: controller.signal });
      return await this.replyOf(response, wanted, hear);
    } finally {
      clearTimeout(deadline);
      clearTimeout(timer);
      this.signal?.removeEventListener("abort", stop);
    }
  }

  /** Return what there is of a reply: as much of a part as was asked for, and little of others. */
  async replyOf(response, length, hear) {
    const { status, statusText, headers } = response;
    const coding = (headers.get("content-encoding") ?? "").trim().toLowerCase();
    const reply = {
      status, headers, reason: `${status} ${statusText}`.trim(),
      coding: coding === "identity" ? "" : coding,
      version: { etag: headers.get("etag"), modified: headers.get("last-modified") },
      asksToWait: secondsOf(headers.get("retry-after")),
      hidesRange: response.type === "cors" && !headers.has("content-range"),
    };
    let most = 0;
    if (status === 206 && !reply.coding) most = length;
    else if (status === 200 && this.size === null) most = MOST_WHOLE;
    else if (MAY_EXPIRE.includes(status)) most = MOST_WORDS;
    // Of a coded body the length is another one; it cannot be longer.
    const isTooLong = status === 200 && Number(headers.get("content-length")) > most;
    if (most === 0 || isTooLong) {
      response.body?.cancel().catch(() => {});
      return reply;
    }
    const body = await bodyOf(response, most, hear);
    if (status === 200 && body.length > most) return reply;
    const range = contentRange(reply);
    const isShort = range && body.length < range.last + 1 - range.first;
    if (status === 206 && isShort && !headers.has("content-length")) {
      throw new Error(`${body.length} bytes came of ${range.text}`); // nothing else tells of a cut
    }
    return { ...reply, body: status === 200 ? body : body.subarray(0, most) };
  }

  changed() {
    return new SourceError(`${this.name} has changed while it was open: open it again`);
  }

  tooSlow(length, seconds) {
    return new SourceError(
      `cannot read ${this.name}: the server has not sent ${length.toLocaleString("en")} bytes in` +
      ` ${Math.round(seconds).toLocaleString("en")} s; try again later`,
    );
  }

  withoutRanges() {
    return new LimitExceededError(
      `${this.name}: the server does not serve byte ranges; files of more than` +
      ` ${MOST_WHOLE >> 20} MiB are not fetched whole: download the file and open it locally, or` +
      " host it where ranges work (nginx, Apache, S3, ...)",
    );
  }

  /** Return the error of a status that brings no bytes. */
  refused({ status, reason, asksToWait, body }) {
    let problem = `HTTP status ${reason}`;
    if (status === 401 && !isSigned(this.url)) {
      const names = Object.keys(this.headers).map((name) => name.toLowerCase());
      problem = names.includes("authorization")
        ? `the server refuses the user and password given (${reason})`
        : `the server wants a login (${reason}): write user and password before the host of the` +
          " URL, user:password@host";
    } else if (MAY_EXPIRE.includes(status) && hasExpired(this.url, new TextDecoder().decode(body))) {
      problem = `the URL has expired (${reason}); get a new one and open it again`;
    } else if (MAY_EXPIRE.includes(status) && isSigned(this.url)) {
      problem += "; the URL is signed: it may have expired, or be signed for another request";
    } else if (asksToWait) {
      problem += `; the server asks to wait ${Math.ceil(asksToWait)} s`;
    }
    return new SourceError(`cannot read ${this.name}: ${problem}`);
  }
}

/** Return a URL as it is asked for, and the header of the user and password in it: fetch takes none. */
function addressOf(text) {
  let url;
  try {
    url = new URL(text, globalThis.document?.baseURI ?? globalThis.location?.href);
  } catch {
    // Relative, where there is no page: for the caller's fetch. Or none that can be asked for.
    return { address: text, login: null };
  }
  if (url.host === "") return { address: text, login: null }; // blob:, data:
  const encode = (part) => part.replace(/%(?![0-9a-f]{2})/gi, "%25");
  const named = `${decoded(url.username)}:${decoded(url.password)}`;
  const isNamed = url.username !== "" || url.password !== "";
  url.username = url.password = url.hash = "";
  url.pathname = encode(url.pathname);
  url.search = encode(url.search);
  const bytes = String.fromCharCode(...new TextEncoder().encode(named));
  return { address: url.href, login: isNamed ? `Basic ${btoa(bytes)}` : null };
}

function decoded(text) {
  try {
    return decodeURIComponent(text);
  } catch {
    return text;
  }
}

/** Return a URL for messages: without query, where secrets live. */
function displayName(address) {
  if (address.startsWith("data:")) return "the data: URL";
  const shown = URL.canParse?.(address) === false ? address.replace(/\/\/.*@/s, "//") : address;
  return shown.split(/[?#]/, 1)[0];
}

/** Compare ETags, weak or strong, or else dates; what was not there is no difference. */
function isSame(known, other) {
  const opaque = (tag) => tag.replace(/^W\//, "");
  if (known.etag && other.etag) return opaque(known.etag) === opaque(other.etag);
  if (known.modified && other.modified) return known.modified === other.modified;
  return !known.etag && !known.modified;
}

function contentRange({ headers }) {
  const text = (headers.get("content-range") ?? "").trim();
  const match = /^bytes (?:(\d{1,15})-(\d{1,15})|\*)\/(\d{1,15})$/.exec(text);
  if (!match) return null;
  const [first, last, size] = match.slice(1).map((digits) => digits && Number(digits));
  return { text, first, last, size };
}

/** Return the seconds of a Retry-After header, a number or a date; 0 if there are none. */
function secondsOf(text) {
  if (/^\s*\d{1,15}\s*$/.test(text ?? "")) return Number(text);
  if (!/\d\d:\d\d:\d\d/.test(text ?? "")) return 0;
  return Math.max((Date.parse(text) - Date.now()) / 1000, 0) || 0;
}

function parameters(address) {
  const query = new URLSearchParams(address.replace(/^[^?]*/, ""));
  return new Map([...query].map(([name, value]) => [name.toLowerCase(), value]));
}

function isSigned(address) {
  const found = parameters(address);
  return SIGNATURES.some((name) => found.has(name));
}

/** Say whether a refused URL has expired, by its own query or by the words of the reply. */
function hasExpired(address, words) {
  if (TELLS_EXPIRY.test(words)) return true;
  return isSigned(address) && endOf(parameters(address)) <= Date.now();
}

/** Return until when a signature holds, NaN if the query does not say so in a known way. */
function endOf(query) {
  for (const cloud of ["x-amz", "x-goog"]) {
    const date = /^(\d{4})(\d\d)(\d\d)T(\d\d)(\d\d)(\d\d)Z$/.exec(query.get(`${cloud}-date`) ?? "");
    if (date) {
      const [year, month, ...rest] = date.slice(1).map(Number);
      return Date.UTC(year, month - 1, ...rest) + 1000 * parseInt(query.get(`${cloud}-expires`), 10);
    }
  }
  if (query.has("se")) {
    const end = query.get("se");
    return Date.parse(/[zZ]$|[+-]\d\d:?\d\d$|^\d{4}-\d\d-\d\d$/.test(end) ? end : `${end}Z`);
  }
  return /^\d+$/.test(query.get("expires") ?? "") ? 1000 * Number(query.get("expires")) : NaN;
}

/** Return a body, or its first bytes: `most` and a few. */
async function bodyOf(response, most, hear) {
  if (!response.body) return new Uint8Array(await response.arrayBuffer());
  const parts = [];
  let size = 0;
  const reader = response.body.getReader();
  for (let part = await reader.read(); !part.done; part = await reader.read()) {
    hear();
    parts.push(part.value);
    size += part.value.length;
    if (size > most) {
      reader.cancel().catch(() => {});
      break;
    }
  }
  if (parts.length === 1) return parts[0];
  const whole = new Uint8Array(size);
  let at = 0;
  for (const part of parts) {
    whole.set(part, at);
    at += part.length;
  }
  return whole;
}
