"""Translation of graphs of single numbers to LLVM IR, and to machine code for the
CPU."""
