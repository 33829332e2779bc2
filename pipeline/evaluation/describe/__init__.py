"""From images to descriptors, kept in memory or in a store."""
