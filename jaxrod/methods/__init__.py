"""Methods: an elastic law, its simplifications, and its integration in time.

| method | law | for |
|---|---|---|
| `consistent()` | loads from a stored energy | everybody; the default |
| `planar("xy")` | the same, in a plane | motion in a plane |
| `torsion_free()` | the same, without twist | straight round rods that nothing twists |
| `implicit()` | the same, any step is stable | stiff rods that move slowly |
| `pyelastica()` | PyElastica 1.0's | comparisons, published results |
| `planar("xy", pyelastica())` | PyElastica 1.0's, in a plane | the same, in a plane |
"""
