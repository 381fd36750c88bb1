"""Lanes in loops: a scene in each lane of a vector, and a loop over the elements.

The program is that of rows, in which operations on rows are loops. Here each number of
a row is a vector, with the numbers of as many scenes. So the code is as short as that
of rows, for any number of elements.
"""
