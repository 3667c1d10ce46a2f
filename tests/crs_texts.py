"""Coordinate reference systems that no code names."""


def sphere(axis, inverse_flattening=0):
    """Return WKT of longitudes and latitudes on a body of a semi-major axis in metres."""
    return (
        f'GEOGCS["s",DATUM["d",SPHEROID["s",{axis},{inverse_flattening}]],'
        'PRIMEM["Reference_Meridian",0],UNIT["degree",0.0174532925199433]]'
    )
