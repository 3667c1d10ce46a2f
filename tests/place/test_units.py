"""Vertical units: the band's, the CRS's, and metres."""

import pytest

from terrainwave.errors import TerrainwaveWarning
from terrainwave.place.units import height_unit, metres_per_unit, unit_text

FOOT_US = 1200 / 3937


def compound(vertical):
    return f'COMPD_CS["c",LOCAL_CS["x",UNIT["metre",1]],VERT_CS[{vertical}]]'


NAVD88_FEET = compound(
    '"NAVD88 height (ftUS)",VERT_DATUM["North American Vertical Datum 1988",2005],'
    'UNIT["US survey foot",0.304800609601219],AXIS["Up",UP]'
)
DEPTH = compound('"MSL depth",VERT_DATUM["Mean Sea Level",2005],UNIT["metre",1],AXIS["Depth",DOWN]')


@pytest.mark.parametrize(
    ("units", "metres"),
    [
        ("ft", 0.3048),
        ("foot", 0.3048),
        ("[ft]", 0.3048),
        ("US survey foot", FOOT_US),
        ("ftUS", FOOT_US),
        ("U.S. Survey Feet", FOOT_US),
        ("US feet", FOOT_US),
        ("ft (US)", FOOT_US),
        ("International feet", 0.3048),
        ("ft.", 0.3048),
        ("kilometers", 1000.0),
        ("millimetres", 0.001),
        ("yards", 0.9144),
        ("fathoms", 1.8288),
        ("metre", 1.0),
        ("us_ft", FOOT_US),
        ("inches", 0.0254),
        ("m above mean sea level", 1.0),
        ("Feet (NAVD88)", 0.3048),
        ("foot (US)", FOOT_US),
        ("Feet (US)", FOOT_US),
        ("Foot_International", 0.3048),
        ("m.a.s.l.", 1.0),
        ("masl", 1.0),
        ("m NAVD88", 1.0),
        ("ft NAVD 88", 0.3048),
        ("m HAE", 1.0),
        ("m AHD", 1.0),
        ("\u00b5m", 1e-6),
        ("", 1.0),
        (None, 1.0),
    ],
)
def test_vertical_units_are_known(units, metres):
    assert metres_per_unit(units) == pytest.approx(metres, rel=1e-12)


def test_an_unknown_vertical_unit_is_told():
    with pytest.warns(TerrainwaveWarning, match="'furlong' is not known"):
        assert metres_per_unit("furlong") == 1


@pytest.mark.parametrize(
    "units",
    ["m/yr", "ms", "m s-1", "m (per year)", "mm/a", "m2", "K", "degrees", "1", "m below sea"],
)
def test_other_quantities_are_no_lengths(units):
    assert height_unit(units, None).length is None


@pytest.mark.parametrize(
    ("units", "crs", "name", "source", "metres", "of_crs"),
    [
        (None, None, None, None, 1.0, None),
        (None, "EPSG:32633", None, None, 1.0, None),
        ("ft", "EPSG:32633", "ft", "band", 0.3048, None),
        (None, "EPSG:4979", "metre", "CRS", 1.0, None),
        (None, "EPSG:7415", "metre", "CRS", 1.0, None),
        (None, NAVD88_FEET, "US survey foot", "CRS", FOOT_US, None),
        ("", NAVD88_FEET, "US survey foot", "CRS", FOOT_US, None),
        ("unspecified", NAVD88_FEET, "US survey foot", "CRS", FOOT_US, None),
        ("Unknown", "EPSG:32633", None, None, 1.0, None),
        ("us-ft", NAVD88_FEET, "us-ft", "band", FOOT_US, None),
        ("m", NAVD88_FEET, "m", "band", 1.0, "US survey foot"),
        ("m", "EPSG:7415", "m", "band", 1.0, None),
        ("ft", "EPSG:7415", "ft", "band", 0.3048, "metre"),
        (None, DEPTH, "metre", "CRS", -1.0, None),
    ],
)  # fmt: skip
def test_the_band_counts_first_then_the_crs(units, crs, name, source, metres, of_crs):
    found = height_unit(units, crs)
    assert (found.name, found.source, found.of_crs) == (name, source, of_crs)
    assert found.metres == pytest.approx(metres, rel=1e-9)


def test_units_as_labels_have_them():
    assert unit_text(" ft ") == "ft"
    assert (unit_text(""), unit_text(None)) == ("unit unknown", "unit unknown")
