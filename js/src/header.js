/** The header (FORMAT.md §4.1). */

import { crc32, viewOf } from "./bytes.js";
import { UnsupportedError, require, requireKnown } from "./errors.js";

export const HEADER_SIZE = 128;
export const HAS_REMAINDERS = 1;
export const HAS_REACH = 8; // tables of rapid have contexts by reach
export const HAS_FILLS = 16; // masks tell fills (§5.4)
export const HAS_WEIGHTS = 32; // tables of rapid have weights of features
export const HAS_CORRECTIONS = 64; // heights are put back while units are decoded (§5.5)
const KNOWN_FEATURES = HAS_REMAINDERS | HAS_REACH | HAS_FILLS | HAS_WEIGHTS | HAS_CORRECTIONS;
const MAGIC = [0x89, 0x54, 0x57, 0x5a, 0x0d, 0x0a, 0x1a, 0x0a];
const METHODS = ["store", "cdf97", "predictive", "cdf53", "rapid"];
const MESHES = ["none", "halves", "zerotree-plain", "rqt", "zerotree-layer", "zerotree-coded",
  "rqt-coefficient"];

/** By code: name, constructor of arrays, bytes, and the range of integers. */
const DTYPES = {
  1: { name: "uint8", array: Uint8Array, bytes: 1, range: [0, 255] },
  3: { name: "uint16", array: Uint16Array, bytes: 2, range: [0, 65535] },
  4: { name: "int16", array: Int16Array, bytes: 2, range: [-32768, 32767] },
  6: { name: "int32", array: Int32Array, bytes: 4, range: [-(2 ** 31), 2 ** 31 - 1] },
  7: { name: "float32", array: Float32Array, bytes: 4, range: null },
  8: { name: "float64", array: Float64Array, bytes: 8, range: null },
};

function gcd(a, b) {
  while (b) [a, b] = [b, a % b];
  return a;
}

/** Read and check the first 128 bytes; `fileSize` is that of the source. */
export function readHeader(bytes, fileSize) {
  require(MAGIC.every((byte, i) => bytes[i] === byte), "not a .twz file: magic");
  require(bytes.length > 8, "the file ends within the header");
  requireKnown(bytes[8] === 1, `format version ${bytes[8]}`);
  require(bytes.length >= HEADER_SIZE, "the file ends within the header");
  const view = viewOf(bytes);
  const uint32 = (at) => view.getUint32(at, true);
  const int32 = (at) => view.getInt32(at, true);
  const float64 = (at) => view.getFloat64(at, true);
  require(view.getUint16(10, true) === HEADER_SIZE, "header_size");
  require(uint32(124) === crc32(bytes.subarray(0, 124)), "header_crc");
  requireKnown(bytes[9] === 0, "reserved byte");
  requireKnown((uint32(12) & ~KNOWN_FEATURES) === 0, `features ${uint32(12)}`);
  requireKnown(bytes[38] === 0 && bytes[39] === 0, "padding");
  requireKnown(bytes[37] < MESHES.length, `mesh ${bytes[37]}`);
  requireKnown(bytes[34] < METHODS.length, `method ${bytes[34]}`);
  requireKnown(bytes[35] in DTYPES, `dtype ${bytes[35]}`);
  requireKnown(bytes[36] <= 9, `effort ${bytes[36]}`);
  const header = {
    features: uint32(12),
    fileSize,
    nRows: uint32(24),
    nCols: uint32(28),
    blockLog2: bytes[32],
    borderRings: bytes[33],
    method: METHODS[bytes[34]],
    dtype: DTYPES[bytes[35]],
    effort: bytes[36],
    mesh: MESHES[bytes[37]],
    quantumNum: view.getBigUint64(40, true),
    quantumDen: view.getBigUint64(48, true),
    base: view.getBigInt64(56, true),
    step: uint32(64),
    zMin: int32(68),
    zMax: int32(72),
    metadataLength: uint32(76),
    maxError: float64(80),
    effectiveBound: float64(88),
    rho: float64(96),
    metadataCrc: uint32(104),
    parametersLength: uint32(108),
    parametersCrc: uint32(112),
    topPageLength: uint32(116),
    meshTolerance: uint32(120),
  };
  check(header, view.getBigUint64(16, true));
  return header;
}

function check(h, statedSize) {
  require(statedSize < 2n ** 63n, "file_size");
  require(h.nRows >= 1 && h.nRows <= 2 ** 31 && h.nCols >= 1 && h.nCols <= 2 ** 31, "n_rows, n_cols");
  require(h.nRows * h.nCols <= 2 ** 50, "n_rows * n_cols");
  require(h.blockLog2 >= 5 && h.blockLog2 <= 10, "block_log2");
  require(h.borderRings === 1 || h.borderRings === 3, "border_rings");
  require(h.method !== "cdf53" || h.borderRings === 1, "border_rings of cdf53");
  require(h.mesh !== "none" || h.meshTolerance === 0, "mesh_tolerance");
  require(h.mesh !== "rqt-coefficient" || h.method === "cdf53", "a mesh by coefficients");
  const { quantumNum: num, quantumDen: den, base } = h;
  require(num >= 1n && num < 2n ** 63n && den >= 1n && den < 2n ** 63n, "quantum");
  require(gcd(num, den) === 1n, "the quantum is not in lowest terms");
  require(((base < 0n ? -base : base) + 2n ** 31n) * num < 2n ** 63n, "base");
  require(h.step % 2 === 1 && h.step < 2 ** 31, "step");
  const hasHeights =
    -(2 ** 30) <= h.zMin && h.zMin <= h.zMax && h.zMax <= 2 ** 30 && h.zMax - h.zMin < 2 ** 30;
  require(hasHeights || (h.zMin === 0 && h.zMax === -1), "z_min, z_max");
  require(h.metadataLength >= 1 && h.metadataLength <= 2 ** 20, "metadata_length");
  require(Number.isFinite(h.maxError) && h.maxError >= 0, "max_error");
  require(h.effectiveBound >= 0 && h.effectiveBound <= h.maxError, "effective_bound");
  require(Number.isFinite(h.rho) && h.rho >= 0, "rho");
  requireKnown(!(h.features & HAS_WEIGHTS) || h.method === "rapid", "weights of another method");
  require(!(h.features & HAS_REACH) || h.method === "rapid", "contexts by reach of another method");
  const mayBeCorrected = ["rapid", "predictive"].includes(h.method) && h.step > 1;
  requireKnown(!(h.features & HAS_CORRECTIONS) || mayBeCorrected,
    `features ${h.features}: corrections of method ${h.method} and step ${h.step}`);
  require(!(h.features & HAS_REACH) || !(h.features & HAS_WEIGHTS), "two layouts of the tables");
  const isOneLevel = Math.max(h.nRows, h.nCols) - 1 <= 2 ** h.blockLog2;
  require(!(h.features & HAS_FILLS) || !isOneLevel, "fills without coarse levels");
  if (h.features & HAS_REMAINDERS) {
    require(["int32", "float32", "float64"].includes(h.dtype.name) && h.method !== "cdf53",
      "remainders of a dtype or a method");
    require(h.step === 1 && h.effectiveBound === 0, "remainders beside a bound");
  } else {
    require(h.rho <= h.maxError, "rho");
  }
  require(h.parametersLength <= 2 ** 16, "parameters_length");
  require(h.topPageLength >= 1 && h.topPageLength <= 2 ** 15, "top_page_length");
  const before = HEADER_SIZE + h.metadataLength + h.parametersLength + h.topPageLength;
  require(BigInt(before) <= statedSize, "file_size");
  require(statedSize === BigInt(h.fileSize),
    `the file has ${h.fileSize} bytes, its header says ${statedSize}`);
}

/** Throw unless this reader decodes the file's method. */
export function requireMethod(header, decoders) {
  if (!(header.method in decoders)) {
    throw new UnsupportedError(
      `method ${header.method} is not decoded by this reader, which knows ` +
        `${Object.keys(decoders).join(", ")}; the Python package reads it`,
    );
  }
}

