"""List for PyInstaller of modules imported by name, data files and the native library."""

from PyInstaller.utils.hooks import (
    collect_data_files,
    collect_dynamic_libs,
    collect_submodules,
)

hiddenimports = collect_submodules("terrainwave", filter=lambda name: ".ext." not in name)
hiddenimports += collect_submodules("rasterio", filter=lambda name: ".rio" not in name)
datas = collect_data_files("terrainwave") + collect_data_files("rasterio")
binaries = collect_dynamic_libs("terrainwave")
# As files, because the cache of kernels identifies them by their sources.
module_collection_mode = "py"
