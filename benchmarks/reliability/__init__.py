"""How reliable the package is: what is done to it, and counted, in numbers that repeat."""
