"""Graphs of single numbers as LLVM IR, and as machine code of this processor."""
