"""The methods that `terrainwave.reference` leaves out: cdf53 and predictive.

Written, as that package is, from docs/FORMAT.md and its annexes alone. To import this package adds
them to its tables.
"""

from reference_decoder.cdf53 import decode_level
from reference_decoder.predictive import decode_predictive, read_tables
from terrainwave.reference import files, payloads, units

files.PARAMETERS["predictive"] = lambda parameters, _step: read_tables(parameters)
payloads.DECODERS["predictive"] = decode_predictive
units.LEVEL_DECODERS["cdf53"] = decode_level
