"""Tasks on the workers of a cluster: running, measuring, retrying."""
