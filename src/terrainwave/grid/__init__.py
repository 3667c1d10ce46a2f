"""Index arithmetic of levels and blocks, and heights as whole numbers of a vertical quantum."""
