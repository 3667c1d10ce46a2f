"""Stencils and weights of whole rasters for the prototype: `python fit.py MODEL DATA CASE ...`.

MODEL is the folder that has the model of whole files (`whole_file.py`), DATA that of the rasters; a
case is the name of a raster, an @ and a bound. Writes CASE.bin here.
"""

import sys

import numpy as np

sys.path.insert(0, sys.argv[1])
import whole_file as model

NAMES = model.NAMES[:4]
LAST_CLASS, N_PLANES = 3, 3


def weights_of(levels, level_class, plane):
    """Return the weights of what is expected, in steps, of the features `NAMES`."""
    weights = [0.0] * len(NAMES)
    have = [
        level
        for level in levels
        if min(level["j"], LAST_CLASS) == level_class and level["q"][plane].size
    ]
    if have:
        use = [name for name in NAMES if name in have[0]["feats"][plane]]
        columns = [
            np.concatenate([level["feats"][plane][name][level["known"][plane]] for level in have])
            for name in use
        ]
        sizes = [np.abs(level["q"][plane][level["known"][plane]]) for level in have]
        fitted = model.fit_magnitude(
            np.stack(columns, 1).astype(float), np.concatenate(sizes).astype(float)
        )
        for name, weight in zip(use, fitted, strict=True):
            weights[NAMES.index(name)] = weight
    return weights


def write(case):
    """Fit one case and write it."""
    name, bound = case.rsplit("@", 1)
    z, valid, n = model.load(f"{sys.argv[2]}/{name}.tif", float(bound))
    low, high = int(z[valid].min()), int(z[valid].max())
    levels, head = model.closed_loop(z, valid, n, low, high, model.TAPS, NAMES, 512, own_only=True)
    n_levels = 1
    while -(-max(z.shape) // (1 << (n_levels - 1))) > 2:
        n_levels += 1
    stencils = {}
    for level in levels:
        stencils.setdefault(min(level["j"], LAST_CLASS), level["weights"])
    size = model.size(model.streams(levels, NAMES))
    bits = (size["symbols"] + size["raw"] + size["tables"] + head) / z.size
    print(f"{case}: step {n}, {bits:.4f} bits a sample in the model", flush=True)
    with open(f"{case}.bin", "wb") as file:
        heads = [*z.shape, n, low, high, n_levels, int(not valid.all()), 0]
        file.write(np.array(heads, "<i4").tobytes())
        for level_class in range(LAST_CLASS + 1):
            weights = np.zeros((N_PLANES, 24), "<i2")
            for plane, own in enumerate(stencils.get(level_class) or stencils[max(stencils)]):
                weights[plane, : len(own)] = own
            file.write(weights.tobytes())
            expected = [weights_of(levels, level_class, plane) for plane in range(N_PLANES)]
            file.write(np.array(expected, "<f8").tobytes())
        file.write(np.where(valid, z, low).astype("<i4").tobytes())
        file.write(valid.astype("u1").tobytes())


for case in sys.argv[3:]:
    write(case)
