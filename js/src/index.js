/** Reads .twz files: terrain compressed by terrainwave. */

export { open, Terrain } from "./terrain.js";
export {
  ArgumentError,
  CorruptStreamError,
  LimitExceededError,
  SourceError,
  TerrainwaveError,
  UnsupportedError,
} from "./errors.js";
