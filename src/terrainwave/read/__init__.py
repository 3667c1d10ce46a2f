"""Heights from a file: units decoded on demand, partial streams, resampling."""
