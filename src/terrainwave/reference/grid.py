"""Levels, blocks and units (docs/FORMAT.md §2)."""

from types import SimpleNamespace

from terrainwave.reference.basics import ceil_div


class Grid:
    """Levels and blocks; a block and a key are tuples (k, m, n)."""

    def __init__(self, n_rows, n_cols, n_cells, border_rings):
        self.size = (n_rows, n_cols)
        self.n_cells = n_cells
        self.rings = (border_rings - 1) // 2  # rings of apron: 0 or 1
        self.k_max = 0
        while ceil_div(max(n_rows, n_cols) - 1, 2**self.k_max) > n_cells:
            self.k_max += 1

    def samples(self, k):
        """Rows and columns of level k (§2.1)."""
        step = 2 ** (self.k_max - k)
        return tuple((n - 1) // step + 1 for n in self.size)

    def n_blocks(self, k):
        """Rows and columns of blocks of level k (§2.2)."""
        step = 2 ** (self.k_max - k)
        return tuple(max(1, ceil_div(ceil_div(n - 1, step), self.n_cells)) for n in self.size)

    def blocks(self, k):
        """Blocks of level k in Morton order (§2.2)."""
        n_m, n_n = self.n_blocks(k)
        return sorted(((k, m, n) for m in range(n_m) for n in range(n_n)), key=morton)

    def root_keys(self):
        """Keys of the roots, in Morton order (§2.4)."""
        return [(-1, m, n) for _, m, n in self.blocks(0)]

    def children(self, block):
        """Children of a block, in Morton order."""
        k, m, n = block
        n_m, n_n = self.n_blocks(k + 1)
        found = [(k + 1, 2 * m + a, 2 * n + b) for a in (0, 1) for b in (0, 1)]
        return [child for child in found if child[1] < n_m and child[2] < n_n]

    def blocks_of_key(self, key):
        """Blocks that a key's unit consists of (§2.4)."""
        return [(0, *key[1:])] if key[0] < 0 else self.children(key)

    def unit(self, key):
        """Level, core, region and shared sides of the unit of a key (§2.4)."""
        k, *place = key
        unit = SimpleNamespace(key=key, level=k + 1, corrections=None)
        n_sides = 1 if k < 0 else 2  # blocks per side
        axes = []
        for i, n_samples, n_blocks in zip(
            place, self.samples(k + 1), self.n_blocks(k + 1), strict=True
        ):
            core_first = n_sides * i * self.n_cells
            core_last = min(n_sides * (i + 1) * self.n_cells, n_samples - 1)
            axes.append(
                SimpleNamespace(
                    core_first=core_first,
                    n_core=core_last - core_first + 1,
                    first=max(core_first - self.rings, 0),
                    last=min(core_last + self.rings, n_samples - 1),
                    shared=(i > 0, n_sides * (i + 1) < n_blocks),
                )
            )
        for axis in axes:
            axis.n = axis.last - axis.first + 1
            axis.core = axis.core_first - axis.first  # the core's first line, in the region
        unit.rows, unit.cols = axes
        return unit


def morton(block):
    _, m, n = block
    return sum(((m >> i & 1) << (2 * i + 1)) | ((n >> i & 1) << (2 * i)) for i in range(40))
