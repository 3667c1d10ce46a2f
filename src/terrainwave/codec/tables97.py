import numpy as np
from terrainwave.coding.rangecoder import new_models
TERM_WEIGHTS = np.zeros((1, 4, 19), dtype=np.int32)
E_WEIGHTS = np.array((24, 22, 9, 9, 11, 21, 8, 70), dtype=np.int64)
def start_residual_models(): return new_models(1381)
def start_tree_models(): return new_models(4124)
def start_border_models(): return new_models(2860)
