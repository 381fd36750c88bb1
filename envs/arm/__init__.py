"""The benchmark's soft arm, its obstacles and its moving target."""
