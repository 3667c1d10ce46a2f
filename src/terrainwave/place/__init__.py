"""Coordinate reference systems: everything that the other packages need to know about them.

`description` reads axes, vertical part and body of a CRS, without pyproj. `system` transforms, with
pyproj, and knows ellipsoids. `position` (`Place`) is what the other packages hold: degrees or
metres, conversion to longitude and latitude, the local frame. `units` has vertical units,
`vertical` heights above the ellipsoid. No other package reads WKT, imports pyproj or asks whether a
CRS is geographic.
"""
