"""Where and what: all that a coordinate reference system says, read once, asked by all rooms.

`description` tells what a CRS says of its axes, its vertical part and its body; that needs no
pyproj. `system` transforms, by pyproj, and knows ellipsoids. `position` (`Place`) is what the other
rooms hold: degrees or metres, the way to longitude and latitude, the local frame. `units` has
vertical units, `vertical` the heights above the ellipsoid. Nobody else reads WKT, imports pyproj or
asks a CRS whether it is geographic.
"""
