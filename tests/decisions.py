"""Decode one payload in plain Python and add up what its decisions should have cost.

Run as a program, with NUMBA_DISABLE_JIT=1, so that the coder's steps can be replaced by ones that
also keep accounts; production kernels stay as they are. It reads the path of a case a line, and
answers with a line. See `tests/codec/test_ideal_length.py`.
"""

import json
import sys
from math import exp, log, log2
from pathlib import Path

import numpy as np

from terrainwave.coding import rangecoder

_COUNT_MASK = (1 << 10) - 1
_PROB_ONE = 1 << 22


class Accounts:
    """Bits of all decisions so far, three ways.

    Attributes
    ----------
    raw : int
        Bits that no model predicts, one each.
    own : float
        By the coder's own models, before anything is rounded to what the coder multiplies with.
    ideal : float
        By exact counting: a context's probability of a one is (w·p₀ + ones) / (w + seen), where p₀
        is its model's start and w = c + 1/2, c the start's count; nothing is forgotten or rounded.
        (The models do the same up to 254 bits seen; from there on they forget, and round always.)
        Where two models vote, both ideals have the mean of the two probabilities, or the mixture of
        their logits with the coder's weights.
    """

    def __init__(self):
        self.clear()

    def clear(self):
        """Begin anew, for another payload."""
        self.raw, self.own, self.ideal, self.n_decisions = 0, 0.0, 0.0, 0
        self._contexts = {}

    def note(self, models, indices, before, bit, weights=None):
        """Add a decision with one or two models, given the models and the weights before it."""
        self.n_decisions += 1
        own, ideal = [], []
        for index, model in zip(indices, before, strict=True):
            prob, count = (model >> 10) / _PROB_ONE, model & _COUNT_MASK
            context = self._contexts.setdefault(
                (id(models), int(index)), [(count + 0.5) * prob, count + 0.5]
            )
            own.append(prob)
            ideal.append(context[0] / context[1])
            context[0] += bit
            context[1] += 1
        own, ideal = together(own, weights), together(ideal, weights)
        self.own -= log2(own if bit else 1 - own)
        self.ideal -= log2(ideal if bit else 1 - ideal)


def together(probs, weights):
    """Return the mean of probabilities or, with weights in 1/65536, the mixture of their logits."""
    if weights is None:
        return sum(probs) / len(probs)
    logit = sum(w / 65536 * log(p / (1 - p)) for w, p in zip(weights, probs, strict=True))
    return 1 / (1 + exp(-logit))


def install(accounts):
    """Replace the coder's steps by ones that keep accounts; before any codec is imported."""
    one, two, raw = rangecoder.code_step, rangecoder.code_mean_step, rangecoder.code_raw_step
    mixed = rangecoder.code_mixed_step

    def code_step(at, state, data, models, is_encoder, index, bit):
        before = [int(models[index])]
        result = one(at, state, data, models, is_encoder, index, bit)
        accounts.note(models, [index], before, result[0])
        return result

    def code_mean_step(at, state, data, models, is_encoder, first, second, bit):
        before = [int(models[first]), int(models[second])]
        result = two(at, state, data, models, is_encoder, first, second, bit)
        accounts.note(models, [first, second], before, result[0])
        return result

    def code_mixed_step(at, state, data, models, is_encoder, first, second, weights, bit):
        before = [int(models[first]), int(models[second])]
        result = mixed(at, state, data, models, is_encoder, first, second, weights, bit)
        accounts.note(models, [first, second], before, result[0], [int(w) for w in weights])
        return result

    def code_raw_step(at, state, data, is_encoder, n_bits, value):
        accounts.raw += int(n_bits)
        return raw(at, state, data, is_encoder, n_bits, value)

    rangecoder.code_step = code_step
    rangecoder.code_mean_step = code_mean_step
    rangecoder.code_mixed_step = code_mixed_step
    rangecoder.code_raw_step = code_raw_step


def decode_case(case, accounts):
    """Decode ``case.bin`` as ``case.json`` says; print the accounts as JSON."""
    from lone_units import lone_spec

    from terrainwave.codec.registry import refiner_by_name

    options = json.loads(Path(f"{case}.json").read_text(encoding="utf-8"))
    refiner = refiner_by_name(options["method"])
    parent = np.load(f"{case}.npy") if options["has_parent"] else None
    spec = lone_spec(tuple(options["shape"]), options["step"], parent=options["has_parent"])
    mask = np.ones(options["shape"], dtype=bool)
    accounts.clear()
    heights, _ = refiner.decode(spec, parent, mask, Path(f"{case}.bin").read_bytes())
    found = {name: getattr(accounts, name) for name in ("raw", "own", "ideal", "n_decisions")}
    print(json.dumps(found | {"checksum": int(heights.astype(np.int64).sum())}), flush=True)


if __name__ == "__main__":
    steps_of_cases = Accounts()
    install(steps_of_cases)
    for line in sys.stdin:
        decode_case(line.rstrip("\n"), steps_of_cases)
