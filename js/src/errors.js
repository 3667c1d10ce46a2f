/** Everything that goes wrong with a file, a source or a request of the caller is one of these. */
export class TerrainwaveError extends Error {
  constructor(message, options) {
    super(message, options);
    this.name = new.target.name;
  }
}

/** The bytes contradict FORMAT.md. */
export class CorruptStreamError extends TerrainwaveError {}

/** The bytes follow rules of a later version, or a method that this reader does not decode. */
export class UnsupportedError extends TerrainwaveError {}

/** The source gave other bytes than asked for: an HTTP error, a file that changed. */
export class SourceError extends TerrainwaveError {}

/** Legal, but larger than the caller allowed. */
export class LimitExceededError extends TerrainwaveError {}

/** An argument that makes no sense for this file. */
export class ArgumentError extends TerrainwaveError {}
