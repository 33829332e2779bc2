"""What a person launches: each job parses, builds, calls and prints; the work is in `shards` and `pipeline`."""
