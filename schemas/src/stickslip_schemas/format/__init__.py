"""How a dataset is stored: arrays, chunks, shards and the manifest."""
