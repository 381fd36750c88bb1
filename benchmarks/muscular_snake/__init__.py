"""PyElastica's muscular snake in both libraries."""
