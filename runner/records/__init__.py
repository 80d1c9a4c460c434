"""What is kept of a flight: recordings, exports, tables, figures, comparisons."""
