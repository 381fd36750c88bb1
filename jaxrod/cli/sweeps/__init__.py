"""Many runs: planned, trained side by side here or on a cluster, told of."""
