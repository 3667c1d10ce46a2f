"""A terrain in longitude and latitude, and tiles of it."""
