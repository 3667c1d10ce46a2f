"""Method cdf53 (docs/format-cdf53.md, whose sections are cited as C.n)."""

import zlib
from types import SimpleNamespace

from reference_decoder.spiht import HL, LH, Spiht, Stop
from terrainwave.reference.basics import clamp, read_varint, require, zeros
from terrainwave.reference.payloads import decode_valid, quanta_of_nodata
from terrainwave.reference.range_coder import Models, RangeDecoder

PIECE = 4096
N_BORDER_MODELS = 24 * 46

# C.2: tiles ---------------------------------------------------------------------------------------


def axis_of(first, last):
    return SimpleNamespace(first=first, last=last, n=last - first + 1)


def part_of(grid, head, level):
    """Return the samples of a level under a block, as an axis of rows and one of columns."""
    axes = []
    for i, n_samples in zip(head[1:], grid.samples(level), strict=True):
        n_cells = grid.n_cells << (level - head[0])
        axes.append(axis_of(i * n_cells, min((i + 1) * n_cells, n_samples - 1)))
    return SimpleNamespace(rows=axes[0], cols=axes[1])


def tiles_of(grid):
    """Return the tiles from the root down."""
    d = max(1, 10 - (grid.n_cells.bit_length() - 1))
    r = grid.k_max % d
    root = (0, 0, 0)
    parts = [part_of(grid, root, level) for level in range(r + 1)]
    tiles = [SimpleNamespace(key=(-1, 0, 0), head=None, first=0, parts=parts, held=(False,) * 4)]
    n_transforms = r + 1
    while (max(grid.samples(r)) - 1) >> n_transforms:
        n_transforms += 1
    tiles[0].n_transforms = n_transforms
    for k in range(r, grid.k_max, d):
        n_rows, n_cols = grid.n_blocks(k)
        for head in grid.blocks(k):
            _, m, n = head
            tile = SimpleNamespace(key=head, head=part_of(grid, head, k), first=k + 1)
            tile.parts = [part_of(grid, head, level) for level in range(k + 1, k + d + 1)]
            tile.n_transforms = d
            tile.held = m > 0, n > 0, m + 1 < n_rows, n + 1 < n_cols  # top, left, bottom, right
            tiles.append(tile)
    return tiles


# C.3: transform -----------------------------------------------------------------------------------


def inverse_line(line, is_held):
    """Undo the lifting of a line, whose s come first; `is_held`: at its start, at its end."""
    n = len(line)
    if n == 1:
        return line
    s, d = line[: (n + 1) // 2], line[(n + 1) // 2 :]
    x = [0] * (n + 1)
    for i, low in enumerate(s):
        left = d[i - 1] if i > 0 else d[0]
        right = d[i] if i < len(d) else d[i - 1]
        is_kept = (i == 0 and is_held[0]) or (2 * i == n - 1 and is_held[1])
        x[2 * i] = low if is_kept else low - ((left + right + 2) >> 2)
    if n % 2 == 0:
        x[n] = x[n - 2]
    for i, high in enumerate(d):
        x[2 * i + 1] = high + ((x[2 * i] + x[2 * i + 2]) >> 1)
    return x[:n]


def inverse_transform(field, tile, sizes):
    """Return the heights of each level of a tile, the coarsest first."""
    top, left, bottom, right = tile.held
    levels = []
    for t in reversed(range(tile.n_transforms)):
        n_rows, n_cols = sizes[t]
        columns = zip(*(row[:n_cols] for row in field[:n_rows]), strict=True)
        columns = [inverse_line(list(column), (top, bottom)) for column in columns]
        rows = [inverse_line(list(row), (left, right)) for row in zip(*columns, strict=True)]
        for row, values in zip(field, rows, strict=False):
            row[:n_cols] = values
        levels.append(rows)
    return levels


# C.4: payload -------------------------------------------------------------------------------------


def section(payload, at):
    n, at = read_varint(payload, at)
    require(n <= len(payload) - at, "section is cut off")
    return payload[at : at + n], at + n


def read_stream(pieces, n_stream):
    """Return the stream without the checksums of its pieces."""
    stream, at = b"", 0
    while len(stream) < n_stream:
        n = min(PIECE, n_stream - len(stream))
        piece, crc = pieces[at : at + n], pieces[at + n : at + n + 4]
        require(len(crc) == 4 and zlib.crc32(piece) == int.from_bytes(crc, "little"), "piece")
        stream += piece
        at += n + 4
    require(at == len(pieces), "bytes after the stream")
    return stream


def parse_payload(file, payload, tile):
    """Return masks by level (None: no section), borders, low, planes and stream."""
    flags, at = payload[0], 1
    require(flags <= (file.header.features & 1), "flags of a tile")
    masks = []
    for _ in tile.parts:
        mask = b""
        if flags & 1:
            mask, at = section(payload, at)
        masks.append(mask or None)
    borders, at = section(payload, at)
    require(bool(borders) == any(tile.held), "borders of a tile")
    low, at = read_varint(payload, at)
    low = -(low + 1) // 2 if low % 2 else low // 2
    require(abs(low) < 2**31 and (low == 0 or tile.head is None), "low of a tile")
    n_planes, at = read_varint(payload, at)
    require(n_planes <= 60, "number of planes")
    n_whole = 0
    for _ in range(n_planes):
        n, at = read_varint(payload, at)
        n_whole += n
    n_stream, at = read_varint(payload, at)
    require(n_stream <= n_whole, "length of the stream")
    crc = int.from_bytes(payload[at : at + 4], "little")
    require(len(payload) >= at + 4 and zlib.crc32(payload[:at]) == crc, "crc of a tile")
    stream = read_stream(payload[at + 4 :], n_stream)
    return SimpleNamespace(
        masks=masks,
        borders=borders,
        low=low,
        n_planes=n_planes,
        stream=stream,
        is_whole=n_stream == n_whole,
    )


def decode_borders(data, field, tile, places):
    """Put the coefficients of held sides into `field`."""
    decoder, models = RangeDecoder(data), Models(N_BORDER_MODELS)
    for side, is_held in zip(("top", "left", "bottom", "right"), tile.held, strict=True):
        for t in reversed(range(tile.n_transforms)) if is_held else ():
            axis, band = (0, HL) if side in ("top", "bottom") else (1, LH)
            line = {p[2:]: place for p, place in places.items() if p[:2] == (t, band)}
            if not line:
                continue
            end = max(at[axis] for at in line) if side in ("bottom", "right") else 0
            before = last = 0
            for row, col in (line[at] for at in sorted(line) if at[axis] == end):
                c = min((2 * last + before).bit_length(), 23)
                value = decoder.magnitude(models, 46 * c, 46 * c + 14, 0)
                before, last = last, value
                field[row][col] = -value if value and decoder.raw(1) else value
    decoder.end()


def decode_stream(head, shape, n_transforms):
    """Return the coefficients of C.5 by their places in F, and all places by coefficient."""
    spiht, models = Spiht(shape, n_transforms), Models(1515)
    decoder = RangeDecoder(head.stream)

    def decide(model, _truth):
        if not head.is_whole and decoder.position > len(head.stream):
            raise Stop
        return decoder.bit(models, model)

    spiht.run(head.n_planes, decide)
    if head.is_whole and head.n_planes:
        decoder.end()
    return spiht.guesses(), spiht.places


# Tiles to heights ---------------------------------------------------------------------------------


def decode_tile(file, payload, tile, above, above_valid):
    """Return (heights in steps, mask) of each level of a tile, the coarsest first."""
    if not payload:
        require(file.header.features & 1, "a tile without a payload in a file without voids")
        for part in tile.parts:
            part.own = zeros(part.rows.n, part.cols.n)
        return [(zeros(p.rows.n, p.cols.n), zeros(p.rows.n, p.cols.n)) for p in tile.parts]
    head = parse_payload(file, payload, tile)
    masks, outer, outer_valid = [], tile.head, above_valid
    for part, mask in zip(tile.parts, head.masks, strict=True):
        valid = decode_valid(file, part, mask, outer, outer_valid)
        masks.append(valid)
        outer, outer_valid = part, valid
    require(any(map(any, masks[0])), "payload of a tile without valid samples")
    finest = tile.parts[-1]
    shape = finest.rows.n, finest.cols.n
    sizes = [tuple(((n - 1) >> t) + 1 for n in shape) for t in range(tile.n_transforms + 1)]
    field = zeros(*shape)
    values, places = decode_stream(head, shape, tile.n_transforms)
    for (row, col), value in values.items():
        field[row][col] = clamp(value, -(2**34), 2**34)
    if any(tile.held):
        decode_borders(head.borders, field, tile, places)
    for i, row in enumerate(above or [[head.low]]):
        field[i][: len(row)] = row
    limit = 2**31 - 1
    levels = [
        [[clamp(z, -limit, limit) for z in row] for row in rows]
        for rows in inverse_transform(field, tile, sizes)[-len(masks) :]
    ]
    return list(zip(levels, masks, strict=True))


def cut(array, holder, part):
    """Cut a part out of the one that holds it."""
    r, c = part.rows.first - holder.rows.first, part.cols.first - holder.cols.first
    return [row[c : c + part.cols.n] for row in array[r : r + part.rows.n]]


def holds(part, level, inner):
    """Say whether a decoded part is of a level and holds all samples of `inner`."""
    return part.level == level and all(
        outer.first <= axis.first and axis.last <= outer.last
        for outer, axis in ((part.rows, inner.rows), (part.cols, inner.cols))
    )


def decode_tiles(file, tiles):
    """Decode tiles, those above first; return all their parts, heights in steps and masks."""
    found = []
    for tile in tiles:
        above = above_valid = None
        if tile.head is not None:
            holder, heights, valid = next(
                one for one in found if holds(one[0], tile.first - 1, tile.head)
            )
            above, above_valid = cut(heights, holder, tile.head), cut(valid, holder, tile.head)
            tile.head.own = cut(holder.own, holder, tile.head)
        for i, part in enumerate(tile.parts):
            part.level = tile.first + i
        decoded = decode_tile(file, file.payloads[tile.key], tile, above, above_valid)
        for part, one in zip(tile.parts, decoded, strict=True):
            found.append((part, *one))
    return found


def decode_level(file, level):
    """Return the parts of a level, their heights in quanta and masks (C.6)."""
    h, taken = file.header, quanta_of_nodata(file)
    require(h.border_rings == 1, "border_rings of cdf53")
    tiles = tiles_of(file.grid)
    others = file.payloads.keys() - {tile.key for tile in tiles}
    require(not any(file.payloads[key] for key in others), "payload of a unit within a tile")

    def final(z, is_valid):
        z = clamp(z * h.step, h.z_min, h.z_max)
        if is_valid and taken and taken[0] <= z <= taken[1]:
            return taken[0] - 1 if taken[1] >= h.z_max else taken[1] + 1
        return z

    return [
        (part, [list(map(final, *pair)) for pair in zip(heights, valid, strict=True)], valid)
        for part, heights, valid in decode_tiles(file, [t for t in tiles if t.first <= level])
        if part.level == level
    ]
