"""Translation of graphs of single numbers to LLVM IR, and to CPU machine code."""
