"""Ways to wrap the model for training: one process and DDP, FSDP2, DeepSpeed ZeRO."""
