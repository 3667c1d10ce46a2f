"""CRS x transform cases: what the raster is, and where pyproj alone says that its samples lie."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pyproj

ROTATED = "+proj=ob_tran +o_proj=longlat +o_lon_p=0 +o_lat_p=39.25 +lon_0=18"
# CF's example of a rotated pole, as a weather model writes it.
CF_POLE = """GEOGCRS["rotated pole",BASEGEOGCRS["on a sphere",DATUM["D",
ELLIPSOID["sphere",6371229,0,LENGTHUNIT["metre",1]]],PRIMEM["Greenwich",0]],
DERIVINGCONVERSION["pole",METHOD["Pole rotation (netCDF CF convention)"],
PARAMETER["Grid north pole latitude (netCDF CF convention)",39.25,
ANGLEUNIT["degree",0.0174532925199433]],
PARAMETER["Grid north pole longitude (netCDF CF convention)",-162,
ANGLEUNIT["degree",0.0174532925199433]],
PARAMETER["North pole grid longitude (netCDF CF convention)",0,
ANGLEUNIT["degree",0.0174532925199433]]],CS[ellipsoidal,2],
AXIS["latitude",north,ANGLEUNIT["degree",0.0174532925199433]],
AXIS["longitude",east,ANGLEUNIT["degree",0.0174532925199433]]]""".replace("\n", "")
GRIB = """GEOGCRS["from GRIB",DATUM["unnamed",ELLIPSOID["Sphere",6371229,0,LENGTHUNIT["metre",1]]],
PRIMEM["Greenwich",0,ANGLEUNIT["degree",0.0174532925199433]],CS[ellipsoidal,2],
AXIS["latitude",north,ANGLEUNIT["degree",0.0174532925199433]],
AXIS["longitude",east,ANGLEUNIT["degree",0.0174532925199433]]]""".replace("\n", "")
MODIS = "+proj=sinu +lon_0=0 +x_0=0 +y_0=0 +R=6371007.181 +units=m"
WRF = "+proj=lcc +lat_1=30 +lat_2=60 +lat_0=39 +lon_0=-97 +R=6370000 +units=m"
HRRR = "+proj=lcc +lat_1=38.5 +lat_2=38.5 +lat_0=38.5 +lon_0=262.5 +R=6371229 +units=m"
TOWGS84 = "+proj=utm +zone=33 +ellps=bessel +towgs84=598.1,73.7,418.2,0.202,0.045,-2.455,6.7"
LONGLAT_TOWGS84 = "+proj=longlat +ellps=bessel +towgs84=598.1,73.7,418.2,0.202,0.045,-2.455,6.7"
MOON = """GEOGCS["Moon 2000",DATUM["D_Moon_2000",SPHEROID["Moon_2000_IAU_IAG",1737400,0]],
PRIMEM["Reference_Meridian",0],UNIT["degree",0.0174532925199433]]""".replace("\n", "")
MARS_EQC = "+proj=eqc +lat_ts=0 +lon_0=0 +a=3396190 +b=3396190 +units=m"
MARS, MARS_SPHEROID = "+proj=longlat +R=3396190", "+proj=longlat +a=3396190 +b=3376200"
LUNA = "+proj=longlat +R=1737400"
EARTH = "OGC:CRS84"

N_ROWS, N_COLS = 33, 41


@dataclass(frozen=True)
class Case:
    """A raster of a plane of heights around a point.

    Parameters
    ----------
    name : str
    crs : str
        As rasterio and pyproj read it.
    centre : (longitude, latitude)
        On the globe below.
    spacing : float
        Of samples, in the CRS's units.
    turn : {"north_up", "south_up", "transposed", "rotated"}
    body : str
    globe : str
        Longitude, latitude on the body, for pyproj.
    metres : float
        Per unit of height, by hand; -1: depths.
    is_curved : bool
        North is elsewhere across the raster, or not up: a polar or derived system.
    x_shift : float
        Added to x, by which longitudes go beyond a turn.
    """

    name: str
    crs: str
    centre: tuple[float, float]
    spacing: float
    turn: str = "north_up"
    body: str = "earth"
    globe: str = EARTH
    metres: float = 1.0
    is_curved: bool = False
    x_shift: float = 0.0

    @cached_property
    def flat(self):
        known = pyproj.CRS.from_user_input(self.crs)
        if known.is_compound:
            known = known.sub_crs_list[0]
        return known.to_2d() if len(known.axis_info) > 2 else known

    @cached_property
    def from_globe(self):
        return pyproj.Transformer.from_crs(self.globe, self.flat, always_xy=True)

    @cached_property
    def to_globe(self):
        return pyproj.Transformer.from_crs(self.flat, self.globe, always_xy=True)

    @cached_property
    def transform(self):
        """Return the affine whose middle lies at the centre."""
        s = self.spacing
        a, b, d, e = {
            "north_up": (s, 0, 0, -s),
            "south_up": (s, 0, 0, s),
            "transposed": (0, s, -s, 0),
            "rotated": (0.8 * s, 0.6 * s, 0.6 * s, -0.8 * s),
        }[self.turn]
        x, y = self.from_globe.transform(*self.centre)
        c = x + self.x_shift - a * N_COLS / 2 - b * N_ROWS / 2
        f = y - d * N_COLS / 2 - e * N_ROWS / 2
        return a, b, c, d, e, f

    def xy(self, rows, cols):
        a, b, c, d, e, f = self.transform
        rows, cols = np.asarray(rows) + 0.5, np.asarray(cols) + 0.5
        return a * cols + b * rows + c, d * cols + e * rows + f

    def lonlat(self, rows, cols):
        x, y = self.xy(rows, cols)
        return np.array(self.to_globe.transform(x, y))

    def samples(self, lon, lat):
        """Return fractional rows and columns of longitudes and latitudes."""
        x, y = self.from_globe.transform(lon, lat)
        a, b, c, d, e, f = self.transform
        if self.flat.is_geographic:
            period = 360 / np.degrees(self.flat.axis_info[0].unit_conversion_factor)
            # x is the longitude, but where the axes go north and west, which PROJ leaves so
            axis = int(self.flat.axis_info[1].direction == "west")
            middle = self.xy((N_ROWS - 1) / 2, (N_COLS - 1) / 2)[axis]
            if axis == 0:
                x = middle + np.mod(x - middle + period / 2, period) - period / 2
            else:
                y = middle + np.mod(y - middle + period / 2, period) - period / 2
        det = a * e - b * d
        cols = (e * (x - c) - b * (y - f)) / det - 0.5
        rows = (a * (y - f) - d * (x - c)) / det - 0.5
        return rows, cols


def plane(rows, cols):
    """Return the heights of every case: a plane, which bilinear interpolation gives back."""
    return 200.0 + 2.0 * np.asarray(cols) + 3.5 * np.asarray(rows)


FOOT, SURVEY_FOOT = 0.3048, 1200 / 3937
METRES = 90.0
DEGREES = 1 / 1200
ON_MARS, ON_SPHEROID = ({"body": "mars", "globe": globe} for globe in (MARS, MARS_SPHEROID))

CASES = [
    # plain geographic
    Case("wgs84", "EPSG:4326", (10.2, 46.1), DEGREES),
    Case("wgs84_south_up", "EPSG:4326", (10.2, 46.1), DEGREES, "south_up"),
    Case("wgs84_transposed", "EPSG:4326", (-70.2, -16.1), DEGREES, "transposed"),
    Case("wgs84_rotated", "EPSG:4326", (10.2, 46.1), DEGREES, "rotated"),
    Case("wgs84_across_180", "EPSG:4326", (179.999, -17.0), DEGREES),
    Case("wgs84_of_0_to_360", "EPSG:4326", (-75.0, 40.0), DEGREES, x_shift=360.0),
    Case("wgs84_a_turn_below", "EPSG:4326", (75.0, 40.0), DEGREES, x_shift=-360.0),
    Case("wgs84_coarse", "EPSG:4326", (10.0, 10.0), 0.5),
    Case("crs84", "OGC:CRS84", (10.2, 46.1), DEGREES),
    Case("etrs89", "EPSG:4258", (10.2, 56.1), DEGREES),
    Case("nad83", "EPSG:4269", (-110.2, 36.1), DEGREES),
    Case("nad27", "EPSG:4267", (-100.2, 40.1), DEGREES),
    Case("osgb36", "EPSG:4277", (-3.2, 56.1), DEGREES),
    Case("pulkovo", "EPSG:4284", (40.2, 56.1), DEGREES),
    Case("china_2000", "EPSG:4490", (100.2, 30.1), DEGREES),
    Case("paris_in_grads", "EPSG:4807", (3.2, 46.1), DEGREES),
    # projected
    Case("utm_33n", "EPSG:32633", (15.2, 47.1), METRES),
    Case("utm_33n_south_up", "EPSG:32633", (15.2, 47.1), METRES, "south_up"),
    Case("utm_33n_transposed", "EPSG:32633", (15.2, 47.1), METRES, "transposed"),
    Case("utm_33n_rotated", "EPSG:32633", (15.2, 47.1), METRES, "rotated"),
    Case("utm_33s", "EPSG:32733", (15.2, -27.1), METRES),
    Case("utm_three_zones_off", "EPSG:32633", (33.4, 50.0), METRES, is_curved=True),
    Case("utm_1n_across_180", "EPSG:32601", (-180.0, 60.0), METRES),
    Case("utm_60s_across_180", "EPSG:32760", (180.0, -20.0), METRES),
    Case("british_grid", "EPSG:27700", (-3.2, 56.1), METRES),
    Case("lambert_93", "EPSG:2154", (2.2, 45.1), METRES),
    Case("europe_laea", "EPSG:3035", (20.2, 50.1), METRES, is_curved=True),
    Case("gauss_krueger_3", "EPSG:31467", (9.2, 48.1), METRES),
    Case("swiss_lv95", "EPSG:2056", (8.2, 46.6), METRES),
    Case("new_zealand", "EPSG:2193", (172.2, -42.1), METRES),
    Case("web_mercator", "EPSG:3857", (8.2, 46.6), METRES),
    Case("ease_2", "EPSG:6933", (8.2, 36.6), METRES),
    Case("canada_lcc", "EPSG:3347", (-95.2, 56.6), METRES),
    Case("conus_albers", "EPSG:5070", (-96.2, 36.6), METRES),
    Case("mollweide", "ESRI:54009", (8.2, 26.6), METRES, is_curved=True),
    Case("krovak_en", "EPSG:5514", (15.2, 49.6), METRES, is_curved=True),
    Case("dutch_rd", "EPSG:28992", (5.2, 52.1), METRES),
    # feet on the map
    Case("new_york_us_feet", "EPSG:2263", (-73.9, 40.7), 300.0),
    Case("california_us_feet", "EPSG:2229", (-118.2, 34.1), 300.0),
    Case("oregon_feet", "EPSG:2913", (-121.2, 44.1), 300.0),
    # equidistant
    Case("plate_carree", "EPSG:4087", (20.2, 10.1), METRES),
    Case("around_a_point", "+proj=aeqd +lat_0=10 +lon_0=20 +datum=WGS84", (20.2, 10.1), METRES),
    # polar
    Case("antarctic", "EPSG:3031", (45.0, -75.0), METRES, is_curved=True),
    Case("arctic_nsidc", "EPSG:3413", (-45.0, 72.0), METRES, is_curved=True),
    Case("north_pole", "EPSG:3995", (0.0, 89.99), METRES, is_curved=True),
    Case("ups_north", "EPSG:32661", (30.0, 85.0), METRES, is_curved=True),
    Case("greenland_n_first", "EPSG:5041", (-40.0, 80.0), METRES, is_curved=True),
    # derived: turned poles
    Case("rotated_pole_sphere", f"{ROTATED} +R=6371229", (10.0, 50.0), 0.01, is_curved=True),
    Case("rotated_pole_wgs84", f"{ROTATED} +ellps=WGS84", (25.0, 60.0), 0.01, is_curved=True),
    Case("rotated_pole_cf", CF_POLE, (10.0, 50.0), 0.01, is_curved=True),
    Case("rotated_pole_south_up", CF_POLE, (18.0, 50.0), 0.01, "south_up", is_curved=True),
    # bound
    Case("bound_utm", TOWGS84, (15.2, 47.1), METRES),
    Case("bound_longlat", LONGLAT_TOWGS84, (15.2, 47.1), DEGREES),
    # compound and three axes
    Case("rd_nap", "EPSG:7415", (5.2, 52.1), METRES),
    Case("new_york_navd88_us_feet", "EPSG:2263+6360", (-73.9, 40.7), 300.0, metres=SURVEY_FOOT),
    Case("utm_navd88_us_feet", "EPSG:26918+6360", (-73.9, 40.7), METRES, metres=SURVEY_FOOT),
    Case("nad83_navd88_feet", "EPSG:4269+8228", (-103.9, 40.7), DEGREES, metres=FOOT),
    Case("wgs84_egm96", "EPSG:4326+5773", (10.2, 46.1), DEGREES),
    Case("wgs84_depth", "EPSG:4326+5715", (-30.2, 46.1), DEGREES, metres=-1.0),
    Case("wgs84_3d", "EPSG:4979", (10.2, 46.1), DEGREES),
    Case("etrs89_3d", "EPSG:4937", (10.2, 56.1), DEGREES),
    # the Earth as a sphere
    Case("grib_sphere", GRIB, (10.2, 46.1), DEGREES),
    Case("modis_sinusoidal", MODIS, (10.2, 46.1), 231.656, is_curved=True),
    Case("wrf_sphere", WRF, (-97.5, 39.1), METRES),
    Case("hrrr_sphere", HRRR, (-97.5, 39.1), METRES),
    # axes to the west or south
    Case("lo29_west_south", "EPSG:2053", (29.5, -26.1), METRES),
    Case("lo29_west_south_turned", "EPSG:2053", (29.5, -26.1), METRES, "transposed"),
    Case("krovak_south_west", "EPSG:5513", (15.2, 49.6), METRES, is_curved=True),
    # other bodies; where axes go north and west PROJ leaves them so
    Case("mars_sphere", "IAU_2015:49900", (137.4, -4.6), DEGREES, **ON_MARS),
    Case("mars_map", "IAU_2015:49910", (37.4, -4.6), METRES, **ON_MARS),
    Case("mars_map_west", "IAU_2015:49911", (37.4, -4.6), METRES, **ON_SPHEROID),
    Case("mars_north_west", "IAU_2015:49901", (37.4, -4.6), DEGREES, **ON_SPHEROID),
    Case("mars_proj4", MARS_EQC, (37.4, -4.6), METRES, **ON_MARS),
    Case("moon_sphere", "IAU_2015:30100", (3.4, 20.6), DEGREES, body="moon", globe=LUNA),
    Case("moon_map", "IAU_2015:30110", (3.4, 20.6), METRES, body="moon", globe=LUNA),
    Case("moon_wkt1", MOON, (3.4, 20.6), DEGREES, body="moon", globe=LUNA),
]  # fmt: skip
