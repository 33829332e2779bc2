"""What every room uses: errors with exit codes, progress, text, files. Imports no torch."""
