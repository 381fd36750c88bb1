"""The benchmark's soft arm, clean and as published, its obstacles and its target."""
