"""Networks that turn an image into features: transformers, ResNets, VGG-16."""
