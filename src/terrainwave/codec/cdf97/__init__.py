"""The method of Yusov & Turlapov 2010: the 9/7 wavelet, zero trees, residuals."""
