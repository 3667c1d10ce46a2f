/** Reads .twz files: terrain compressed by terrainwave. */

export type Heights =
  | Uint8Array
  | Uint16Array
  | Int16Array
  | Int32Array
  | Float32Array
  | Float64Array;

export type DtypeName = "uint8" | "uint16" | "int16" | "int32" | "float32" | "float64";

/** Bytes start … end - 1 are asked for, and must come. */
export interface ByteSource {
  readonly size: number;
  read(start: number, end: number): Promise<Uint8Array | ArrayBuffer>;
}

export interface OpenOptions {
  /** Decoded units that are kept; 2^27 unless told. */
  cacheBytes?: number;
  /** Larger reads are refused; 2^28 unless told. */
  maxSamples?: number;
  /**
   * Threads that read parts of a window, 0 to 64; 0: the caller's. Unless told: on pages the
   * number of cores less one, at most 4; elsewhere 0. Where none can start, the caller's reads.
   */
  workers?: number;
  /** Of URLs: instead of the global one. */
  fetch?: typeof fetch;
  headers?: Record<string, string>;
  /** Ends `open` and all reads, which reject with its reason. */
  signal?: AbortSignal;
  /** Of URLs: fetch and keep whole blocks of 128 KiB, those of many reads at once together. */
  blocks?: boolean;
}

export interface Shape {
  nRows: number;
  nCols: number;
}

/** In samples of a level. */
export interface Window extends Shape {
  row: number;
  col: number;
}

export interface ReadOptions {
  /**
   * Rule for void samples of a coarse level: "exact", where the full grid is; "any", those alone
   * around which nothing is valid. Default: exact.
   */
  voids?: "exact" | "any";
}

export interface Read extends Window {
  level: number;
  /** In the file's dtype, row by row; void samples hold nodata, NaN or 0. */
  heights: Heights;
  /** 1 where a sample is valid, else 0. */
  valid: Uint8Array;
}

export function open(
  from: string | URL | Blob | ArrayBuffer | ArrayBufferView | ByteSource,
  options?: OpenOptions,
): Promise<Terrain>;

/** A multiresolution raster of heights. Level 0 is the coarsest, -1 the full grid. */
export class Terrain {
  private constructor();
  readonly nRows: number;
  readonly nCols: number;
  readonly nLevels: number;
  /** Bytes of the file. */
  readonly fileSize: number;
  /** Cells per side of a block. */
  readonly blockSize: number;
  readonly dtype: DtypeName;
  readonly method: string;
  /** The bound asked for and the one that holds at valid samples of the full grid, physical units. */
  readonly maxError: number;
  readonly effectiveBound: number;
  /** Least and greatest valid raw height of the original, within rounding to quanta (rawRho) and the bound. */
  readonly rawMin: number;
  readonly rawMax: number;
  readonly rawRho: number;
  /** Side of the original on which physical heights lie: 1 above, -1 below, 0 both. */
  readonly boundSide: -1 | 0 | 1;
  /** All of FORMAT.md §4.2 that the file tells. */
  readonly metadata: Readonly<Record<string, unknown>>;
  readonly crs: string | null;
  readonly units: string | null;
  /** Meaning of the heights where the file says it: depths go down, radii count from the body's centre. */
  readonly heightsAre: "height" | "depth" | "radius" | null;
  readonly scale: number;
  readonly offset: number;
  readonly nodata: number | null;
  readonly bounds: { left: number; bottom: number; right: number; top: number };
  shape(level?: number): Shape;
  /** a, b, c, d, e, f: x = a·col + b·row + c, y = d·col + e·row + f at the corners of pixels. */
  transform(level?: number): [number, number, number, number, number, number];
  /** True if samples may be void; false: none is. */
  readonly hasVoids: boolean;
  /** Parts of the window beyond the level are cut off. */
  read(level?: number, window?: Partial<Window>, options?: ReadOptions): Promise<Read>;
  /** Bilinear, in physical units; NaN outside the samples and beside voids. */
  sample(x: number, y: number, options?: { level?: number } & ReadOptions): Promise<number>;
  /** The stored error of a block's surface, in physical units. */
  blockError(level: number, row: number, col: number): Promise<number>;
  /** Root of the file's digests as it states it, 64 hexadecimal digits; null without digests. */
  statedRoot(): Promise<string | null>;
  /** Digest of a tile of 512 x 512 samples of the full grid, fewer at the last ones: 32 bytes. ArgumentError: the arrays do not fit. */
  digest(tile: Shape & { heights: Heights; valid: Uint8Array }): Promise<Uint8Array>;
  /** Root of all heights, by the digests of all tiles, row by row: as `statedRoot`, if nothing is damaged. */
  rootOf(digests: Uint8Array): Promise<string>;
  /** Rows and columns of blocks. */
  blockShape(level?: number): Shape;
  /** Give memory back, and end the workers; reads are refused from now on. */
  close(): Promise<void>;
}

export class TerrainwaveError extends Error {}
/** The bytes contradict the format. */
export class CorruptStreamError extends TerrainwaveError {}
/** A later version of the format. */
export class UnsupportedError extends TerrainwaveError {}
/** The server or the caller's source gave other bytes than asked for. */
export class SourceError extends TerrainwaveError {}
/** Larger than the caller allowed. */
export class LimitExceededError extends TerrainwaveError {}
export class ArgumentError extends TerrainwaveError {}
