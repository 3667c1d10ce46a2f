"""Heights out of a file: units decoded on demand, parts of streams, resampling."""
