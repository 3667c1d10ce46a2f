"""Files get the digests of their heights, however these are coded, and keep them."""

import numpy as np
import pytest
from conformance.editor import Editor
from strategies import terrain_like, write_geotiff
from twz import grouped, twz_bytes

import terrainwave as tw
from terrainwave.errors import CorruptStreamError, InvalidArgumentError
from terrainwave.reference.digests import root_of, section_of
from terrainwave.reference.files import read_file
from terrainwave.write.meshes import store_meshes

NODATA = -32768
OPTIONS = {"max_error": 0, "block": 32, "threads": 1, "mesh": "none"}


def with_voids(n_rows=700, n_cols=560):
    heights = terrain_like(n_rows, n_cols, seed=2)
    heights[40:90, 500:530] = NODATA
    heights[512:, 512:] = NODATA  # a tile
    return heights


@pytest.fixture
def raster(tmp_path):
    return write_geotiff(tmp_path / "dem.tif", with_voids(), nodata=NODATA, units=("m",))


def digest_of(path):
    with tw.open(path) as terrain:
        assert list(terrain.check(terrain.digest())) == []
        return terrain.digest()


@pytest.mark.few(1)
@pytest.mark.parametrize(
    "options",
    [
        {"method": "store"},
        {"method": "predictive", "block": 64},
        {"method": "cdf97", "border_rings": 3},
        {"method": "cdf53"},
        {"block": 1024, "mesh": "rqt"},
    ],
    ids=str,
)
def test_the_same_heights_have_one_root_however_they_are_coded(tmp_path, raster, options):
    tw.compress(raster, tmp_path / "first.twz", **OPTIONS)
    tw.compress(raster, tmp_path / "other.twz", **OPTIONS | grouped(options))
    assert digest_of(tmp_path / "other.twz") == digest_of(tmp_path / "first.twz")


def test_heights_that_went_through_a_geotiff_keep_their_root(tmp_path):
    heights = terrain_like(300, 310, dtype="float32", seed=2)
    source = write_geotiff(tmp_path / "dem.tif", heights, units=("m",))
    tw.compress(source, tmp_path / "lossy.twz", **OPTIONS | {"max_error": 0.3})
    tw.decompress(tmp_path / "lossy.twz", tmp_path / "back.tif")
    tw.compress(tmp_path / "back.tif", tmp_path / "exact.twz", **OPTIONS)
    assert digest_of(tmp_path / "exact.twz") == digest_of(tmp_path / "lossy.twz")


@pytest.mark.parametrize("dtype", ["uint8", "int32", "float32", "float64"])
def test_a_files_digests_are_those_of_what_it_decodes_to(tmp_path, dtype):
    heights = (terrain_like(40, 570, seed=3) / 20).astype(dtype)
    tw.compress(heights, tmp_path / "a.twz", **OPTIONS | {"max_error": 3})
    with tw.open(tmp_path / "a.twz") as terrain:
        decoded, valid = terrain.read_with_mask()
        assert section_of(decoded, valid) == terrain.container.digests().pack()
        header = terrain.header
        found = root_of(header, header.metadata, dtype, section_of(decoded, valid)[:32])
        assert terrain.digest() == found


@pytest.mark.few(1)
@pytest.mark.parametrize("height", [0, 7], ids=["0", "7"])
@pytest.mark.parametrize("max_error", [0, 3])
def test_sea_has_the_digests_of_its_heights(tmp_path, height, max_error):
    # Segments of blocks of 32 have 512 samples a side: those of sea are proved by their bytes.
    heights = np.full((1700, 1700), height, np.int16)
    heights[:300, :300] = terrain_like(300, 300, seed=4)
    source = write_geotiff(tmp_path / "dem.tif", heights, tiled=True, blockxsize=64, blockysize=64)
    tw.compress(source, tmp_path / "a.twz", **OPTIONS | {"max_error": max_error})
    with tw.open(tmp_path / "a.twz") as terrain:
        decoded, valid = terrain.read_with_mask()
        assert list(terrain.check()) == []
        assert terrain.container.digests().pack() == twz_section(decoded, valid)


def twz_section(decoded, valid):
    """Return the section of heights by windows that lie otherwise than those of the proof."""
    from terrainwave.container.digests import TileDigests, tile_digests
    from terrainwave.grid.quadtree import Region

    tiles, whole = TileDigests(decoded.shape), Region(0, 0, *decoded.shape)
    for window in whole.tiles(1024, 512):
        part = window.slices_in(whole)
        tiles.add(tile_digests(window, decoded[part], valid[part]))
    return tiles.tree().pack()


def test_digests_are_off_where_asked_and_without_the_proof(tmp_path):
    heights = with_voids(40, 50)
    for options in ({"digest": False}, {"verify": False}):
        tw.compress(heights, tmp_path / "a.twz", overwrite=True, **OPTIONS | options)
        with tw.open(tmp_path / "a.twz") as terrain:
            assert terrain.digest() is None
            assert list(terrain.check()) == []
    assert not read_file(tw.compress_to_bytes(heights, max_error=0)).digests
    with pytest.raises(InvalidArgumentError, match="found digest without verify"):
        tw.compress(heights, tmp_path / "b.twz", **OPTIONS, digest=True, verify=False)


def patched(tmp_path, raster, **options):
    """Return a file and a raster that changes one corner of it."""
    path = tmp_path / "dem.twz"
    tw.compress(raster, path, **OPTIONS | options)
    return path, changed_part(tmp_path, raster)


def changed_part(tmp_path, raster):
    import rasterio

    with rasterio.open(raster) as dataset:
        part = dataset.read(1)[:30, :40]
        part[part != NODATA] //= 2
        profile = {"transform": dataset.transform, "crs": dataset.crs}
    return write_geotiff(tmp_path / "part.tif", part, nodata=NODATA, units=("m",), **profile)


@pytest.mark.full
@pytest.mark.parametrize("max_error", [0, 4])
def test_a_patch_makes_the_digests_anew(tmp_path, raster, max_error):
    path, part = patched(tmp_path, raster, max_error=max_error, height_range=(-1000, 9000))
    before = digest_of(path)
    tw.patch(path, part)
    after = digest_of(path)
    assert after != before
    assert tw.verify(path, root=before).problems == (
        f"the root of the heights is {after}, expected {before}",
    )


@pytest.mark.full
def test_a_patch_adds_no_digests(tmp_path, raster):
    path, part = patched(tmp_path, raster, digest=False, height_range=(-1000, 9000))
    tw.patch(path, part)
    assert digest_of_none(path)


def digest_of_none(path):
    with tw.open(path) as terrain:
        return terrain.digest() is None


@pytest.mark.full
def test_a_patch_refuses_digests_that_are_not_those_of_heights_beyond_it(tmp_path):
    heights = terrain_like(4, 4200, seed=2)
    source = write_geotiff(tmp_path / "dem.tif", heights, units=("m",))
    path, part = patched(tmp_path, source, height_range=(-1000, 9000))
    other = np.array(heights)
    other[2, 4100] += 1
    tw.compress(
        write_geotiff(tmp_path / "other.tif", other, units=("m",)), tmp_path / "other.twz",
        **OPTIONS, height_range=(-1000, 9000),
    )  # fmt: skip
    editor = Editor(path.read_bytes())
    editor.end = Editor((tmp_path / "other.twz").read_bytes()).end
    path.write_bytes(editor.bytes())
    found = path.read_bytes()
    with pytest.raises(CorruptStreamError, match="4 x 104 samples from row 0, column 4096"):
        tw.patch(path, part)
    assert path.read_bytes() == found


@pytest.mark.full
def test_stored_meshes_leave_digests_as_they_are(tmp_path, raster):
    tw.compress(raster, tmp_path / "a.twz", **OPTIONS)
    store_meshes(tmp_path / "a.twz", tmp_path / "b.twz", mesh="rqt")
    assert digest_of(tmp_path / "b.twz") == digest_of(tmp_path / "a.twz")


def altered(tmp_path, *, has_new_digests):
    """Return a file of other heights than it was made of, with checksums that match."""
    heights = terrain_like(700, 20, seed=2)
    other = np.array(heights)
    other[600, 10] += 1
    one, two = (twz_bytes(array, max_error=0, digest=True) for array in (heights, other))
    editor = Editor(two)
    if not has_new_digests:
        editor.end = Editor(one).end
    path = tmp_path / "altered.twz"
    path.write_bytes(editor.bytes())
    with tw.open(one) as terrain:
        return path, terrain.digest()


def test_heights_that_are_not_those_of_their_digest_are_found(tmp_path):
    path, root = altered(tmp_path, has_new_digests=False)
    (problem,) = tw.verify(path).problems
    assert problem == (
        "heights of 700 x 20 samples from row 0, column 0 are not those of their digest"
    )
    assert len(tw.verify(path, root=root).problems) == 2


def test_heights_with_digests_of_their_own_are_found_by_the_root_only(tmp_path):
    path, root = altered(tmp_path, has_new_digests=True)
    assert tw.verify(path).ok
    (problem,) = tw.verify(path, root=root.upper()).problems
    assert problem.endswith(f"expected {root}")


@pytest.mark.parametrize("root", ["", "12", "g" * 64, 5])
def test_what_is_no_root_is_refused(tmp_path, root):
    path, _ = altered(tmp_path, has_new_digests=True)
    with pytest.raises(InvalidArgumentError, match="expected 64 hexadecimal digits"):
        tw.verify(path, root=root)


def test_a_window_is_checked_by_the_digests_of_its_squares(tmp_path):
    """Three squares of 4096 samples beside each other; heights of the last one are other ones."""
    heights = np.zeros((40, 9000), np.int16)
    heights[:, 8500:] = np.arange(500)
    path = tmp_path / "a.twz"
    tw.compress(heights, path, max_error=0, method="store")
    with tw.open(path) as terrain:
        root = terrain.digest()
    heights[3, 8600] += 7
    tw.compress(heights, tmp_path / "b.twz", max_error=0, method="store")
    editor = Editor((tmp_path / "b.twz").read_bytes())
    editor.end = path.read_bytes()[-(32 * 4 + 8) :]  # the top and three leaves
    forged = tmp_path / "c.twz"
    forged.write_bytes(editor.bytes())
    assert tw.verify(forged, window=(0, 0, 40, 8000), root=root).ok
    (problem,) = tw.verify(forged, window=(0, 8190, 10, 10)).problems
    assert "40 x 808 samples from row 0, column 8192" in problem
    assert not tw.verify(forged).ok
    (problem,) = tw.verify(forged, window=(0, 0, 9, 9), root="0" * 64).problems
    assert "expected 000" in problem
    with pytest.raises(InvalidArgumentError, match="expected one of them"):
        tw.verify(forged, window=(0, 0, 9, 9), mesh=True)
    damaged = bytearray(path.read_bytes())
    damaged[-(len(damaged) // 2)] ^= 1  # in the heights
    forged.write_bytes(damaged)
    assert tw.verify(forged, window=(0, 0, 40, 9000)).problems
    tw.compress(heights, path, digest=False, overwrite=True)
    (problem,) = tw.verify(path, window=(0, 0, 9, 9)).problems
    assert "no digests" in problem
