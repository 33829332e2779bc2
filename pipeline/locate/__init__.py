"""Where was this photo taken: an index of a user's own photos, and answers from it."""
