"""The method whose streams can end early: the reversible 5/3 wavelet, tiles of several levels."""
