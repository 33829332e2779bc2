"""Photos on disk -> WebDataset tar shards and their Parquet index. Imports no torch."""
