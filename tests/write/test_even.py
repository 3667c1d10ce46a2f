"""What a source knows to be void or of one value is not read, and files stay what they are."""

import gc
import random
import shutil
import tracemalloc

import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine
from strategies import terrain_like

import terrainwave as tw
from terrainwave.codec.unit_specs import unit_spec
from terrainwave.container.page import page_layout
from terrainwave.container.targets.kept import Kept
from terrainwave.container.writer import SpoolSink
from terrainwave.errors import StorageError
from terrainwave.grid.parameters import CodecParameters
from terrainwave.grid.quadtree import SEGMENT_LEVELS, Block, Grid, Region
from terrainwave.raster_io.even import Even, even_parts
from terrainwave.raster_io.source import RasterSource
from terrainwave.read import decoder as decoder_module
from terrainwave.read.coded import EvenBlocks
from terrainwave.verification import original
from terrainwave.verification.original import Original
from terrainwave.write import encoder
from terrainwave.write.encoder import Repeats
from terrainwave.write.passes import proof, resuming
from terrainwave.write.passes.found import Found
from terrainwave.write.passes.windows import check_free_space

SIDE = 2600
VOID = -9999


def write_tif(path, heights, row=0, col=0, *, nodata=VOID, **options):
    """Write a GeoTIFF; without heights one of SIDE samples whose blocks have no bytes."""
    n_rows, n_cols = (SIDE, SIDE) if heights is None else heights.shape
    profile = dict(
        driver="GTiff", height=n_rows, width=n_cols, count=1, dtype="int16", nodata=nodata,
        crs="EPSG:32632", transform=Affine(1, 0, col, 0, -1, -row), tiled=True, blockxsize=64,
        blockysize=64, SPARSE_OK=True,
    )  # fmt: skip
    with rasterio.open(path, "w", **profile | options) as dataset:
        if heights is not None:
            dataset.write(heights, 1)
    return path


def vrt(path, entries, *, side=SIDE, nodata=VOID, extra=""):
    """Write a VRT of entries: (file, row, column, rows, columns), or an element as text."""
    sources = [
        entry
        if isinstance(entry, str)
        else "<ComplexSource><SourceFilename relativeToVRT='1'>{0}</SourceFilename>"
        "<SourceBand>1</SourceBand><SrcRect xOff='0' yOff='0' xSize='{4}' ySize='{3}'/>"
        "<DstRect xOff='{2}' yOff='{1}' xSize='{4}' ySize='{3}'/>"
        f"<NODATA>{VOID}</NODATA></ComplexSource>".format(*entry)
        for entry in entries
    ]
    value = "" if nodata is None else f"<NoDataValue>{nodata}</NoDataValue>"
    path.write_text(
        f"<VRTDataset rasterXSize='{side}' rasterYSize='{side}'>"
        "<GeoTransform>0,1,0,0,0,-1</GeoTransform>"
        f"<VRTRasterBand dataType='Int16' band='1'>{value}{extra}{''.join(sources)}"
        "</VRTRasterBand></VRTDataset>"
    )
    return path


@pytest.fixture(scope="module")
def tiles(tmp_path_factory):
    """A folder with a tile of heights and voids, and one of 0 whose blocks have no bytes."""
    folder = tmp_path_factory.mktemp("even")
    heights = terrain_like(120, 150, dtype="int16", seed=3) + 200
    heights[20:60, 30:90] = VOID
    write_tif(folder / "tile.tif", heights)
    write_tif(folder / "sea.tif", None, nodata=None, height=700, width=900)
    write_tif(folder / "sparse.tif", None)
    with rasterio.open(folder / "sparse.tif", "r+") as dataset:
        for row, col in ((64, 128), (2000, 1300)):
            window = rasterio.windows.Window(col, row, 150, 120)
            dataset.write(heights, 1, window=window)
    return folder


def sources_of(folder):
    """Return rasters with voids or constants that are known without reading them."""
    tile = ("tile.tif", 120, 150)
    entries = [(tile[0], row, col, *tile[1:]) for row, col in ((5, 9), (1400, 1801), (1460, 1900))]
    sea = ("sea.tif", 1800, 300, 700, 900)
    return {
        "vrt": vrt(folder / "vrt.vrt", entries),
        "sea": vrt(folder / "sea.vrt", [sea, *entries[:2]]),
        "no nodata": vrt(folder / "none.vrt", entries, nodata=None),
        "sparse": folder / "sparse.tif",
        "mosaic": [
            write_tif(folder / f"m{row}.tif", terrain_like(90, 80, dtype="int16"), row, col)
            for row, col in ((0, 0), (1900, 2300), (1950, 2340))
        ],
    }


NAMES = ("vrt", "sea", "no nodata", "sparse", "mosaic")


@pytest.mark.parametrize("name", NAMES)
def test_even_regions_are_what_is_read(tiles, name, monkeypatch):
    source = RasterSource(sources_of(tiles)[name], warn=False)
    shape = source.info.n_rows, source.info.n_cols
    parts = list(even_parts(Region(0, 0, *shape), 64, source.even))
    assert sum(part.n_rows * part.n_cols for part, _ in parts) == shape[0] * shape[1]
    assert sum(p.n_rows * p.n_cols for p, even in parts if even) > 0.8 * shape[0] * shape[1]
    with monkeypatch.context() as patch:
        patch.setattr(RasterSource, "even", lambda *_: None)
        heights, valid = source.read(0, 0, *shape)
    for part, even in parts:
        if even is not None:
            at = part.slices_in(Region(0, 0, *shape))
            assert (heights[at] == even.value).all()
            assert (valid[at] == even.is_valid).all()
    again = source.read(0, 0, *shape)
    assert np.array_equal(again[0], heights)
    assert np.array_equal(again[1], valid)


@pytest.mark.few(1)
@pytest.mark.filterwarnings("ignore::terrainwave.TerrainwaveWarning")
@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("vrt", {"block": 32}),
        ("sea", {"block": 64, "max_error": 3, "keep_origin": True}),
        ("no nodata", {"block": 128}),
        ("sparse", {"block": 256, "measure_meshes": True}),
        ("mosaic", {"block": 64}),
        ("sea", {"method": "cdf97", "max_error": 2}),
    ],
)
def test_files_are_the_same_whether_a_source_knows_its_voids_or_not(
    tiles, tmp_path, name, options, monkeypatch
):
    source = sources_of(tiles)[name]
    tw.compress(source, tmp_path / "known.twz", **options)
    monkeypatch.setattr(RasterSource, "even", lambda *_: None)
    tw.compress(source, tmp_path / "read.twz", **options)
    assert (tmp_path / "known.twz").read_bytes() == (tmp_path / "read.twz").read_bytes()


@pytest.mark.full
def test_voids_that_a_source_knows_are_never_read(tiles, tmp_path, monkeypatch):
    n_read = 0
    read = RasterSource.read

    def counted(self, row, col, n_rows, n_cols):
        nonlocal n_read
        if self.even(Region(row, col, n_rows, n_cols)) is None:
            n_read += n_rows * n_cols
        return read(self, row, col, n_rows, n_cols)

    monkeypatch.setattr(RasterSource, "read", counted)
    source = vrt(tmp_path / "large.vrt", [("tile.tif", 70000, 30000, 120, 150)], side=100_000)
    (tmp_path / "tile.tif").write_bytes((tiles / "tile.tif").read_bytes())
    tw.compress(source, tmp_path / "large.twz")
    assert n_read < 10_000_000
    with tw.open(tmp_path / "large.twz") as terrain:
        assert len(list(terrain.coded_parts(Region(0, 0, *terrain.shape)))) <= 4
        assert not terrain.read_with_mask((0, 0, 9, 9))[1].any()
        assert terrain.read_with_mask((70000, 30000, 9, 9))[1].all()
    # What stands for void subtrees is nothing: an index page for each level of four at most.
    assert (tmp_path / "large.twz").stat().st_size < 40_000


def element(**changes):
    parts = {
        "tag": "SimpleSource", "more": "", "src": "xOff='0' yOff='0' xSize='900' ySize='700'",
        "dst": "xOff='100' yOff='100' xSize='900' ySize='700'",
    } | changes  # fmt: skip
    return (
        "<{tag}><SourceFilename relativeToVRT='1'>sea.tif</SourceFilename>"
        "<SourceBand>1</SourceBand><SrcRect {src}/><DstRect {dst}/>{more}</{tag}>"
    ).format(**parts)


@pytest.mark.parametrize(
    "changes",
    [
        {"tag": "ComplexSource", "more": "<ScaleOffset>5</ScaleOffset>"},
        {"tag": "ComplexSource", "more": "<LUT>0:7,1:9</LUT>"},
        {"dst": "xOff='100.3' yOff='100' xSize='900' ySize='700'"},
        {"dst": "xOff='100' yOff='100' xSize='450' ySize='350'"},
        {"src": "xOff='0' yOff='0' xSize='900' ySize='900'"},
        {"src": "xOff='-1' yOff='0' xSize='900' ySize='700'"},
        {"tag": "KernelFilteredSource", "more": "<Kernel><Size>3</Size><Coefs>1 1 1 1 1 1 1 1 1"
         "</Coefs></Kernel>"},
    ],
)  # fmt: skip
def test_sources_of_a_vrt_that_do_more_than_copy_are_read(tiles, tmp_path, changes, monkeypatch):
    path = vrt(tiles / f"odd{random.random()}.vrt", [element(**changes)], side=1200)
    source = RasterSource(path, warn=False)
    assert source.even(Region(300, 300, 10, 10)) is None
    with rasterio.open(path) as dataset:
        whole = dataset.read(1)
    for part, even in even_parts(Region(0, 0, 1200, 1200), 16, source.even):
        if even is not None:
            assert (whole[part.slices_in(Region(0, 0, 1200, 1200))] == even.value).all()


@pytest.mark.parametrize("far", ["1200", "2000000000", "1e300"])
def test_a_source_beyond_a_vrt_changes_no_gap(tiles, far):
    dst = f"xOff='{far}' yOff='100' xSize='900' ySize='700'"
    path = vrt(tiles / f"far{random.random()}.vrt", [element(dst=dst)], side=1200)
    try:
        source = RasterSource(path, warn=False)
    except StorageError:  # GDAL refuses the numbers
        return
    assert source.even(Region(300, 300, 10, 10)) == (VOID, False)


def test_adjoining_tiles_of_one_height_are_known_as_one(tiles, tmp_path):
    path = vrt(
        tiles / "adjoining.vrt",
        [("sea.tif", row, col, 700, 900) for row in (100, 800) for col in (50, 950)],
    )
    source = RasterSource(path, warn=False)
    even = source.even(Region(100, 50, 1400, 1800))
    assert even is not None
    assert (even.value, even.is_valid) == (0, True)
    assert source.even(Region(100, 50, 1401, 1800)) is None
    assert source.even(Region(1500, 50, 10, 10)).is_valid is False


@pytest.fixture(scope="module")
def sea(tiles):
    """A file of which some of the finest segments are sea alone, with its raster."""
    path = vrt(
        tiles / "large sea.vrt",
        [
            *(("sea.tif", row, col, 700, 900) for row in range(0, 2800, 700)
              for col in range(0, 2700, 900)),
            ("tile.tif", 400, 700, 120, 150),
        ],
        side=2700,
    )  # fmt: skip
    tw.compress(path, tiles / "sea.twz", block=32)
    return path, tiles / "sea.twz"


@pytest.fixture
def decoded(monkeypatch):
    """The keys of units in the order in which they are decoded."""
    keys = []
    decode = decoder_module.TreeDecoder._decode

    def noted(self, key, *begun):
        keys.append(key)
        return decode(self, key, *begun)

    monkeypatch.setattr(decoder_module.TreeDecoder, "_decode", noted)
    return keys


def test_sea_is_proved_by_its_bytes(sea, decoded):
    with RasterSource(sea[0], warn=False) as source, tw.open(sea[1]) as terrain:
        found = list(proof.unproved(terrain, source, terrain.grid))
        blocks = [one for one in found if isinstance(one, Block)]
        assert len(blocks) > 5
        assert sum(proof._n_samples(terrain.grid, one) for one in found) == 2700 * 2700
        assert proof.Comparison(terrain, source, 0.0, has_digests=True).all(blocks).error == 0
        n_finest = sum(key.level == terrain.grid.k_max - 1 for key in decoded)
        assert n_finest == 1


@pytest.fixture(scope="module")
def higher(sea, tiles):
    """The raster of `sea`, with a tile in its middle that is 5 m higher."""
    write_tif(tiles / "high.tif", None, nodata=5, height=700, width=900)
    entry = (
        f"<SimpleSource><SourceFilename relativeToVRT='0'>{tiles}/high.tif</SourceFilename>"
        "<SourceBand>1</SourceBand><SrcRect xOff='0' yOff='0' xSize='900' ySize='700'/>"
        "<DstRect xOff='900' yOff='1400' xSize='900' ySize='700'/></SimpleSource>"
    )
    other = tiles / "higher.vrt"
    other.write_text(sea[0].read_text().replace("</VRTRaster", entry + "</VRTRaster"))
    return other


def test_sea_of_another_height_is_found_by_the_proof(sea, higher):
    with RasterSource(higher, warn=False) as source, tw.open(sea[1]) as terrain:
        assert source.even(Region(1500, 1000, 9, 9)).value == 5
        comparison = proof.Comparison(terrain, source, 1.0, has_digests=True)
        within = Region(1536, 1024, 512, 512)
        found = list(proof.unproved(terrain, source, terrain.grid, within))
        assert all(isinstance(one, Block) for one in found)
        with pytest.raises(tw.BoundViolationError, match="is 5 off"):
            comparison.all(found)
        assert (
            comparison.all(proof.unproved(terrain, source, terrain.grid, Region(0, 0, 9, 9))).error
            < 1
        )


@pytest.mark.full
def test_what_payloads_tell_of_units_is_what_they_decode_to(higher, tmp_path):
    tw.compress(higher, tmp_path / "a.twz", block=32)
    with tw.open(tmp_path / "a.twz") as terrain:
        even = EvenBlocks(terrain.container, terrain.decoder)
        told = set()
        for segment in terrain.container.present_segments():
            for key in segment.layout.keys:
                height = even.of_unit(key)
                told.add((key.level, height))
                unit = terrain.decoder.unit(key)
                is_one = unit.validity.mask is None and bool((unit.heights == height).all())
                assert height is None or is_one
        last = terrain.grid.k_max - 1
        finest = {height for level, height in told if level == last and height is not None}
        assert {height + terrain.header.base for height in finest} == {0, 5}


@pytest.mark.full
def test_sea_in_subtrees_that_are_kept_is_coded_once(sea, tmp_path, monkeypatch):
    monkeypatch.setattr(resuming, "LEAST_SAMPLES", 1)
    monkeypatch.setattr(resuming, "SUBTREE_SIDE", 1024)
    n_coded = n_kept = 0
    code, encode_kept = encoder.TreeEncoder.code_unit, encoder.TreeEncoder._encode_kept

    def counted(*arguments):
        nonlocal n_coded
        n_coded += 1
        return code(*arguments)

    def noted(*arguments):
        nonlocal n_kept
        n_kept += 1
        return encode_kept(*arguments)

    monkeypatch.setattr(encoder.TreeEncoder, "code_unit", counted)
    monkeypatch.setattr(encoder.TreeEncoder, "_encode_kept", noted)
    tw.compress(sea[0], tmp_path / "kept.twz", block=32)
    assert (tmp_path / "kept.twz").read_bytes() == sea[1].read_bytes()
    assert n_kept > 3
    with tw.open(sea[1]) as terrain:
        assert n_coded < terrain.grid.n_units() // 2


def test_check_decodes_sea_once(sea, decoded):
    with tw.open(sea[1]) as terrain:
        assert list(terrain.check()) == []
        assert len(decoded) < terrain.grid.n_units() // 2


@pytest.fixture
def shapes_read(monkeypatch):
    """The shapes of windows that are read of originals."""
    shapes, read = [], Original.read

    def noted(self, row, col, *shape):
        shapes.append(shape)
        return read(self, row, col, *shape)

    monkeypatch.setattr(Original, "read", noted)
    return shapes


@pytest.mark.parametrize("name", ["vrt", "sparse"])
def test_verify_reads_samples_of_voids_that_both_files_know(
    tiles, tmp_path, name, monkeypatch, shapes_read
):
    source = sources_of(tiles)[name]
    tw.compress(source, tmp_path / "a.twz")
    monkeypatch.setattr(original, "_WINDOW_SIDE", 256)
    report = tw.verify(tmp_path / "a.twz", source)
    assert report.ok
    assert report.errors.n_valid > 10_000
    assert sum(rows * cols for rows, cols in shapes_read) < SIDE**2 // 3
    assert shapes_read.count((1, 1)) >= 5


@pytest.mark.full
def test_verify_finds_heights_where_the_original_knows_a_void(tiles, tmp_path):
    sources = sources_of(tiles)
    tw.compress(sources["sea"], tmp_path / "a.twz")
    report = tw.verify(tmp_path / "a.twz", sources["vrt"])
    assert any("void in one of the two" in problem for problem in report.problems)
    assert report.errors.n_mask_differences > 600_000


def test_verify_does_not_believe_an_index_that_is_wrong(tiles, monkeypatch):
    with rasterio.open(sources_of(tiles)["vrt"]) as dataset:
        raster = Original(dataset, 1, None)
        even = Even(np.int16(VOID), False)
        assert raster.holds(Region(700, 700, 300, 300), even)
        assert not raster.holds(Region(700, 700, 300, 300), Even(np.int16(0), True))
        assert not raster.holds(Region(5, 9, 110, 140), even)
        monkeypatch.setattr(original, "_WINDOW_SIDE", 256)
        monkeypatch.setattr(Original, "_even", lambda *_: Even(np.int16(0), True))
        assert all(known is None for _, known in raster.windows())


@pytest.mark.full
@pytest.mark.parametrize("max_error", [0, 3])
def test_verify_reads_one_sample_of_sea_that_decodes_to_one_height(
    sea, tmp_path, monkeypatch, shapes_read, max_error
):
    tw.compress(sea[0], tmp_path / "a.twz", block=32, max_error=max_error)
    monkeypatch.setattr(original, "_WINDOW_SIDE", 128)
    report = tw.verify(tmp_path / "a.twz", sea[0])
    assert report.ok
    assert sum(rows * cols for rows, cols in shapes_read) < 2700**2 // 2
    monkeypatch.setattr(Original, "_even", lambda *_: None)
    plain = tw.verify(tmp_path / "a.twz", sea[0])
    assert sum(rows * cols for rows, cols in shapes_read) > 2700**2
    assert report.errors.n_valid == plain.errors.n_valid == 2700**2
    assert report.errors.max_error == plain.errors.max_error
    assert report.errors.rmse == pytest.approx(plain.errors.rmse)


@pytest.mark.full
def test_verify_finds_sea_of_another_height(sea, higher, monkeypatch):
    monkeypatch.setattr(original, "_WINDOW_SIDE", 128)
    report = tw.verify(sea[1], higher)
    assert any("further from the original" in problem for problem in report.problems)
    monkeypatch.setattr(Original, "_even", lambda *_: None)
    assert report.problems == tw.verify(sea[1], higher).problems


def test_tiles_of_a_geotiff_that_are_void_take_no_bytes(tiles, tmp_path):
    source = sources_of(tiles)["vrt"]
    tw.compress(source, tmp_path / "a.twz")
    tw.decompress(tmp_path / "a.twz", tmp_path / "back.tif")
    with rasterio.open(tmp_path / "back.tif") as back, rasterio.open(source) as original:
        assert np.array_equal(back.read(1), original.read(1))
        offsets = [
            back.get_tag_item(f"BLOCK_OFFSET_{col}_{row}", "TIFF", bidx=1)
            for (row, col), _ in back.block_windows(1)
        ]
    assert sum(offset is not None for offset in offsets) < len(offsets) // 3


def test_an_index_that_is_wrong_is_found_by_the_proof(tiles, tmp_path, monkeypatch):
    # As if the tile were not where the VRT says.
    even = RasterSource.even

    def wrong(self, region):
        moved = region._replace(row=max(region.row - 600, 0))
        return even(self, moved)

    monkeypatch.setattr(RasterSource, "even", wrong)
    with pytest.raises(tw.BoundViolationError, match="index"):
        tw.compress(sources_of(tiles)["vrt"], tmp_path / "a.twz", block=32)
    assert not (tmp_path / "a.twz").exists()


def test_nodata_that_gdal_takes_for_equal_is_in_doubt(tmp_path):
    """The least float32 with 15 digits: GDAL's comparison has a tolerance."""
    least = float(np.finfo(np.float32).min)
    for name, value in (("sea", 0.0), ("void", least)):
        with rasterio.open(
            tmp_path / f"{name}.tif", "w", driver="GTiff", width=SIDE, height=SIDE, count=1,
            dtype="float32", nodata=None if value == 0 else least, tiled=True, blockxsize=64,
            blockysize=64, SPARSE_OK=True,
        ):  # fmt: skip
            pass
    place = f'xOff="0" yOff="0" xSize="{SIDE}" ySize="{SIDE}"'
    sources = "".join(
        f'<ComplexSource><SourceFilename relativeToVRT="1">{name}.tif</SourceFilename>'
        f"<SourceBand>1</SourceBand><SrcRect {place}/><DstRect {place}/>{nodata}</ComplexSource>"
        for name, nodata in (("sea", ""), ("void", "<NODATA>-3.40282346638529e+38</NODATA>"))
    )
    path = tmp_path / "both.vrt"
    path.write_text(
        f'<VRTDataset rasterXSize="{SIDE}" rasterYSize="{SIDE}">'
        f'<VRTRasterBand dataType="Float32" band="1"><NoDataValue>{least!r}</NoDataValue>'
        f"{sources}</VRTRasterBand></VRTDataset>"
    )
    with rasterio.open(path) as dataset:
        assert (dataset.read(1) == 0).all()
    with RasterSource(path) as source:
        assert source.even(Region(0, 0, SIDE, SIDE)) is None
        heights, valid = source.read(0, 0, SIDE, SIDE)
    assert valid.all()
    assert (heights == 0).all()


@pytest.mark.parametrize(("rings", "n_clipped"), [(1, 0), (3, 13)])
def test_blocks_whose_aprons_are_cut_are_no_repeats(rings, n_clipped):
    """A neighbour of one shared line only: `is_inside` counts it, and its samples end there."""
    grid = Grid(2050, 2050, 32)
    parameters = CodecParameters(1, 0, 9, (1, 0), rings, 0)
    repeats = Repeats(grid, parameters, None)
    inside = [block for block in grid.blocks(4) if grid.is_inside(block)]
    shapes = {block: unit_spec(grid, parameters, block).region.shape for block in inside}
    whole = max(shapes.values())
    clipped = [block for block in inside if shapes[block] != whole]
    assert len(clipped) == n_clipped
    assert not any(repeats._is_whole(block) for block in clipped)
    kept = [block for block in inside if repeats._is_whole(block)]
    assert len(kept) == len(inside) - n_clipped


def test_room_on_the_disk_is_asked_for_what_may_not_be_even(tmp_path, monkeypatch):
    write_tif(tmp_path / "a.tif", terrain_like(100, 100))
    path = vrt(tmp_path / "wide.vrt", [("a.tif", 0, 0, 100, 100)], side=100_000)
    needed = 1024**2 * 4 // 3  # a window around the tile: heights of all levels above it
    usage = shutil.disk_usage(tmp_path)
    with RasterSource(path) as source:
        monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=needed))
        check_free_space(source, tmp_path)
        monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=needed - 1))
        with pytest.raises(StorageError, match="name another directory"):
            check_free_space(source, tmp_path)


@pytest.mark.full
def test_finished_units_take_little_memory(tmp_path):
    """Segments that are stored, and subtrees in the journal of a run: at most 64 bytes a unit."""
    grid = Grid(1 << 16, 1 << 16, 256)
    with Kept(tmp_path, {"run": 1}) as kept:
        units, sink = resuming.KeptUnits(kept, grid, "rapid"), SpoolSink(grid, tmp_path)
        n_units = 0

        def finish(head):
            keys = grid.segment_groups(head)
            for key in keys:
                sink(key, b"payload")
                sink.spools[head].codes[key] = bytes(16)
            sink.store(head)
            for start in grid.children(head):
                below = [key for key in keys if key.level > start.level and is_below(key, start)]
                units.save(start, Found(payloads=dict.fromkeys(below, b"payload")))
            return len(keys)

        heads = grid.blocks(grid.k_max - SEGMENT_LEVELS)[:120]
        tracemalloc.start()
        try:
            for number, head in enumerate(heads):
                n_units += finish(head)
                if number in (19, 119):
                    page_layout.cache_clear()
                    gc.collect()
                if number == 19:
                    first = tracemalloc.get_traced_memory()[0], n_units
            used = tracemalloc.get_traced_memory()[0] - first[0]
        finally:
            tracemalloc.stop()
        assert used <= 64 * (n_units - first[1])


def is_below(key, block):
    depth = key.level - block.level
    return (key.row >> depth, key.col >> depth) == (block.row, block.col)
