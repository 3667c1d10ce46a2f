"""Where files are written: beside their names until they are whole, or to storage by a URL."""
