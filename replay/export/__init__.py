"""Export transitions as data sets of other libraries."""

# name -> (module, library that it needs or "", ending of the file's name or "" for a directory)
FORMATS: dict[str, tuple[str, str, str]] = {
    "minari": ("minari_hdf5", "minari", ""),
    "d3rlpy": ("one_file", "h5py", ".h5"),
    "lerobot": ("lerobot_v3", "", ""),
    "parquet": ("one_file", "", ".parquet"),
}
