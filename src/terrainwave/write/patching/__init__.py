"""The passes of `patch`: targets, units that are coded again, what the index says then."""
