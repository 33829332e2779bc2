"""From descriptors to the nearest database images: exact, approximate, PCA, re-ranking."""
