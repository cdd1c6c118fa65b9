"""Array code as machine code: traced once, printed for LLVM, compiled in this process.

`tracer` runs the code on variables and keeps what it does in a `program`. `llvm` prints programs as
vector instructions, over arrays as `layout` lays them, and compiles them by `llvmlite`. The results
have the bits that NumPy gives: the operations are the same, in the same order, and none is fused
with another.
"""

from .program import Program
from .tracer import TracedArray, Untraceable, lift, once, read

__all__ = ["Program", "TracedArray", "Untraceable", "lift", "once", "read"]
