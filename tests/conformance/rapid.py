"""Bytes of method rapid that no encoder writes (docs/format-rapid.md R.1, R.8, R.10)."""

from unittest.mock import patch

import numpy as np
from reference_decoder.mixing import RangeEncoder

from conformance.editor import varint
from terrainwave.reference import payloads, rapid, units
from terrainwave.reference.basics import read_varint
from terrainwave.reference.files import read_file
from terrainwave.reference.range_coder import Models
from terrainwave.reference.rapid_tables import CORE, CUTS, PAIRS, PLANES, SAMPLES, TAPS, WEIGHTS

N_STATES = (1, 8, 32)
START = 65536  # of states, when encoding begins
REST_PAIR, REST_SAMPLE = 112, 31


class Payload:
    """The bytes of rapid in a payload, taken apart, to be changed (R.1)."""

    def __init__(self, data):
        self.flags, at = data[0], 1
        self.shift = None
        if not self.flags & 1:
            self.shift, at = data[1], 2
        self.number = None  # v, of the origin
        if self.flags & 32:
            self.number, at = read_varint(data, at)
        self.sizes, self.bands = [], []
        for _ in range((self.flags >> 3 & 3) + 1):
            n_words, at = read_varint(data, at)
            n_raw, at = read_varint(data, at)
            self.sizes.append([n_words, n_raw])
        for n_words, n_raw in self.sizes:
            parts = []
            for n in (4 * self.n_states, 2 * n_words, n_raw):
                parts.append(bytearray(data[at : at + n]))
                at += n
            self.bands.append(parts)  # states, words, raw bits
        assert at == len(data)

    @property
    def n_states(self):
        """The number of states of each band."""
        return N_STATES[self.flags >> 1 & 3]

    def set_origin(self, k):
        """Let the origin be this far from the middle."""
        self.flags |= 32
        self.number = 2 * k if k >= 0 else -2 * k - 1

    def set_wide(self, shift):
        """Let the unit not be narrow."""
        self.flags &= ~1
        self.shift = shift

    def set_narrow(self):
        """Let the unit be narrow."""
        self.flags |= 1
        self.shift = None

    def set_flags(self, flags):
        """Set flags beside those that are set."""
        self.flags |= flags

    def claim(self, part, n):
        """State so many more words (part 0) or bytes of raw bits (part 1) than there are."""
        self.sizes[0][part] += n

    def add_bands(self, n, state=START):
        """Put bands without words and bits before the others; they hold strips in small groups."""
        for _ in range(n):
            self.flags += 8
            self.sizes.insert(0, [0, 0])
            states = bytearray(state.to_bytes(4, "little") * self.n_states)
            self.bands.insert(0, [states, bytearray(), bytearray()])

    def bytes(self):
        """Return the bytes; `sizes` are those stated."""
        head = bytes([self.flags]) + (b"" if self.shift is None else bytes([self.shift]))
        head += b"" if self.number is None else varint(self.number)
        head += b"".join(varint(n) for size in self.sizes for n in size)
        return head + b"".join(bytes(part) for band in self.bands for part in band)


def put_magnitude(encoder, models, group, m):
    """Write a magnitude of a group (R.10; `FORMAT.md` §6.5)."""
    first, prefix = 46 * group, 46 * group + 14
    for k in range(min(m, 14)):
        encoder.bit(models, first + k, 1)
    if m < 14:
        encoder.bit(models, first + m, 0)
        return
    n_bits = (m - 13).bit_length() - 1
    for k in range(n_bits):
        encoder.bit(models, prefix + k, 1)
    if n_bits < 31:
        encoder.bit(models, prefix + n_bits, 0)
    encoder.raw(m - 13 - (1 << n_bits), n_bits)


class Section:
    """A parameters section, to be changed before it is written (R.10).

    Attributes
    ----------
    stencils : list of (int, int, dict or None)
        By tier and plane: the set, shift, and changes by number of the tap.
    weights : list of list of int
        Codes by tier and plane.
    cut : int
    frequencies : dict of int to list of int
        Codes of own tables: those of pairs by class, those of samples from 60 on.
    """

    def __init__(self, family=0, level=0):
        self.family, self.level = family, level
        self.stencils = [(0, 0, None)] * 12
        self.weights = [
            list(codes[: 3 + (plane != "HH")])
            for tier in WEIGHTS[family]
            for plane, codes in zip(PLANES, tier, strict=True)
        ]
        self.cut = CUTS[family]
        self.frequencies = {}

    def trained(self, table):
        """Return the codes of a table of the family."""
        return list(PAIRS[self.family][table] if table < 60 else SAMPLES[self.family][table - 60])

    def bytes(self):
        """Return the section."""
        encoder, models = RangeEncoder(), Models(646)

        def put_codes(groups, known, codes):
            size = 0
            for g, code in zip(known, codes, strict=True):
                change = code - g
                assert change >= 0 or g, "codes that are usually 0 have no sign"
                put_magnitude(encoder, models, groups + size + 3 * (g > 0), abs(change))
                if change and g:
                    encoder.raw(int(change < 0), 1)
                size = min(abs(change).bit_length(), 2)

        for index, (which, shift, changes) in enumerate(self.stencils):
            encoder.raw(which, 4)
            encoder.raw(int(changes is not None), 1)
            if changes is None:
                continue
            encoder.raw(shift, 3)
            plane = PLANES[index % 3]
            for tap, place in enumerate(TAPS[plane]):
                if place != CORE[plane][0]:
                    m = changes.get(tap, 0)
                    put_magnitude(encoder, models, int(place not in CORE[plane]), abs(m))
                    if m:
                        encoder.raw(int(m < 0), 1)
        for known, codes in zip(Section(self.family).weights, self.weights, strict=True):
            put_codes(8, known, codes)
        encoder.raw(self.cut, 6)
        was_own = 0
        for table in [*range(min(self.cut, 60)), *range(60, 121)]:
            codes = self.frequencies.get(table)
            encoder.bit(models, 644 + was_own, int(codes is not None))
            was_own = int(codes is not None)
            if was_own:
                rest = REST_PAIR if table < 60 else REST_SAMPLE
                known = self.trained(table)
                put_codes(2, known[:rest] + known[rest + 1 :], codes[:rest] + codes[rest + 1 :])
        return bytes([self.level | self.family << 5]) + encoder.end()


def section(edit, family=0):
    """Return a parameters section after `edit` has changed it."""
    found = Section(family)
    edit(found)
    return found.bytes()


def random_section(rng):
    """Return a parameters section of which nothing is trained, but for what it builds on."""
    found = Section(int(rng.integers(6)), int(rng.integers(4)))
    for index in range(12):
        plane = PLANES[index % 3]
        changes = {
            tap: int(rng.integers(-90, 91)) for tap in range(len(TAPS[plane])) if rng.random() < 0.5
        }
        found.stencils[index] = (int(rng.integers(16)), int(rng.integers(4)), changes)
    found.weights = [[int(code) for code in rng.integers(0, 256, len(w))] for w in found.weights]
    found.cut = int(rng.integers(61))
    for table in range(121):
        if rng.random() < 0.2:
            n = 226 if table < 60 else 64
            found.frequencies[table] = [int(code) for code in rng.integers(0, 19, n)]
    return found.bytes()


# Payloads of anything ---------------------------------------------------------------------------


class DrawnBand(rapid.Band):
    """In a band's place it answers at random; `parts` are the bytes of what it answered (R.8).

    A `share` of symbols is drawn from all alike, the others by their frequencies.
    """

    def __init__(self, rng, n_states, share, last_state):
        super().__init__([last_state] * n_states, [], b"")
        self.rng, self.share, self.log, self.answered = rng, share, [], []

    def symbols(self, entries):
        found = [None] * len(entries)
        for k, entry in enumerate(entries):
            if entry is not None:
                f, below = entry
                if self.rng.random() < self.share:
                    y = int(self.rng.choice(np.flatnonzero(f)))
                else:
                    y = int(np.searchsorted(below, self.rng.integers(4096), side="right")) - 1
                found[k] = y
                self.log.append((f[y], below[y], k % len(self.states)))
        return found

    def raw(self, n):
        self.n_used += n
        number = int(self.rng.integers(1 << n))
        self.answered.append((number, n))
        return number

    def end(self):
        pass

    def parts(self):
        """Return states, words and raw bits."""
        states, words = list(self.states), []
        for f, below, i in reversed(self.log):
            x = states[i]
            if x >= f << 20:
                words.append(x & 65535)
                x >>= 16
            states[i] = 4096 * (x // f) + below + x % f
        number, n_bits = 0, 0
        for value, n in self.answered:
            number |= value << n_bits
            n_bits += n
        return [
            b"".join(x.to_bytes(4, "little") for x in states),
            b"".join(word.to_bytes(2, "little") for word in reversed(words)),
            number.to_bytes((n_bits + 7) // 8, "little"),
        ]


def random_bytes(rng, last_state, file, unit, valid, parent_unit, parent_heights):
    """Return the bytes of the method for a unit, legal and otherwise random, and its heights."""
    h = file.header
    is_narrow = int(h.step <= 8191 and rng.random() < 0.6)
    which = int(rng.integers(3))
    n_bands = 1 if parent_unit is None else int(rng.integers(1, 5))
    shift = 0 if is_narrow else int(rng.integers(31))
    most = ((h.z_max - h.z_min) >> 1) >> (10 + shift)
    k = int(rng.integers(-most, most + 1))
    share = rng.choice([0, 0.05, 0.5])
    bands = [DrawnBand(rng, N_STATES[which], share, last_state) for _ in range(n_bands)]
    with patch.object(rapid, "read_payload", lambda *_: (is_narrow, shift, k, bands)):
        heights = rapid.decode_rapid(file, unit, b"", valid, parent_unit, parent_heights)
    found = Payload.__new__(Payload)
    found.flags = is_narrow | which << 1 | (n_bands - 1) << 3
    found.shift, found.number = None if is_narrow else shift, None
    if k or rng.random() < 0.2:
        found.set_origin(k)
    found.bands = [band.parts() for band in bands]
    found.sizes = [[len(words) // 2, len(raw)] for _, words, raw in found.bands]
    return found.bytes(), heights


def draw_payloads(editor, seed, last_state=START):
    """Give all units of a file of one segment, none beside another, bytes of anything."""
    rng, file = np.random.default_rng(seed), read_file(editor.bytes())
    decode_payload = units.decode_payload

    def drawn(file, unit, payload, *parent):
        made = []

        def decode(file, unit, _, valid, *parent):
            made.extend(random_bytes(rng, last_state, file, unit, valid, *parent))
            return made[1]

        with patch.dict(payloads.DECODERS, rapid=decode):
            decoded = decode_payload(file, unit, payload, *parent)
        n_sections = len(payload) - len(own_bytes(payload))
        editor.top.payloads[unit.key] = payload[:n_sections] + made[0]
        return decoded

    with patch.object(units, "decode_payload", drawn):
        units.decode_units(file, file.grid.k_max)


def own_bytes(payload):
    """Return what of a payload is the method's: what follows its sections (`FORMAT.md` §5.1)."""
    at = 1
    for bit in range(4):
        if payload[0] >> bit & 1:
            n, start = read_varint(payload, at)
            at = start + n
    return payload[at:]
