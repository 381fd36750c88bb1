"""PyElastica's plectoneme in both libraries."""
