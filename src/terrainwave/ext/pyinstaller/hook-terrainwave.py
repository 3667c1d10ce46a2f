"""Modules that PyInstaller does not find, because they are imported by name, and data files."""

from PyInstaller.utils.hooks import collect_data_files, collect_submodules

hiddenimports = collect_submodules("terrainwave", filter=lambda name: ".ext." not in name)
hiddenimports += collect_submodules("rasterio", filter=lambda name: ".rio" not in name)
datas = collect_data_files("terrainwave") + collect_data_files("rasterio")
# As files, because the cache of kernels identifies them by their sources.
module_collection_mode = "py"
