/** Types that all map libraries share. */

import { ByteSource } from "../index.js";

/** Encodings of heights in pixels of terrain-RGB tiles. */
export type Encoding = "mapbox" | "terrarium";

/** One terrain of a folder that `terrainwave publish` wrote; `described` is its entry. */
export interface PublishedTerrain {
  name: string;
  url: URL;
  described: {
    name: string;
    file: string;
    /** West, south, east, north in degrees; east may be beyond 180. */
    bounds: [number, number, number, number];
    maxzoom: number;
    /** Of the tiles that nobody asks for in another one; "mapbox" where it is missing. */
    encoding?: Encoding;
    /** Metres. */
    lowest: number;
    highest: number;
    /** The bound at samples of the full grid, metres. */
    error: number;
    /** Tags that tell source and licence: text of the file, untrusted. */
    origin: Record<string, string>;
    [more: string]: unknown;
  };
}

export function publishedTerrains(url?: string): Promise<PublishedTerrain[]>;

/** Metres: of a tile's surface from the samples', and of the originals from the latter. */
export interface TileErrors {
  error: number | null;
  terrainError: number | null;
}

/** Has tiles made in a worker. */
export class TileMaker {
  constructor(options?: { worker?: Worker });
  /** Read the terrain of this name from the page's own source, not from its URL. */
  bring(name: string, source: ByteSource): void;
  ask(terrain: PublishedTerrain, what: "height", args: [lon: number, lat: number],
    signal?: AbortSignal): Promise<{ lon: number; lat: number; height: number | null; max_error: number }>;
  /** By default in the encoding "mapbox", with opaque voids, and with errors, which take most of the time. */
  ask(terrain: PublishedTerrain, what: "rgb",
    args: [z: number, x: number, y: number, rim: number,
      look?: { encoding?: Encoding; transparentVoids?: boolean; errors?: boolean }],
    signal?: AbortSignal): Promise<({ image: ImageBitmap } & TileErrors) | null>;
  ask(terrain: PublishedTerrain, what: "heightmap",
    args: [z: number, x: number, y: number, size: number],
    signal?: AbortSignal): Promise<{ heights: Float32Array; holes: Uint8Array | null } & TileErrors>;
  /** In deck.gl's common space: see mesh.js. */
  ask(terrain: PublishedTerrain, what: "mesh",
    args: [z: number, x: number, y: number, size: number],
    signal?: AbortSignal): Promise<{
      positions: Float32Array; normals: Float32Array; places: Float32Array; indices: Uint32Array;
      lowest: number; highest: number;
    } & TileErrors>;
}
