"""Array code as machine code: traced once, printed for LLVM, compiled in this process.

`tracer` runs the code on variables and keeps what it does as a list of operations. `llvm` prints
the list as vector instructions and compiles them by `llvmlite`. The results have the bits that
NumPy gives: the operations are the same, in the same order, and none is fused with another.
"""

from .llvm import compiled, trouble
from .tracer import Trace, TracedArray

__all__ = ["Trace", "TracedArray", "compiled", "trouble"]
