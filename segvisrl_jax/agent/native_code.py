"""Functions in LLVM's intermediate representation, written loop by loop, that XLA's programs on the CPU call.

Whole numbers are 64 bit, or Python's. All other numbers are float32, alone or as vectors.
"""

import ctypes
import functools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import jax
from llvmlite import binding, ir

from segvisrl_jax import ffi


def _host_features() -> binding.FeatureMap:
    """What this processor can do; nothing where LLVM cannot tell."""
    try:
        return binding.get_host_cpu_features()
    except RuntimeError:
        return binding.FeatureMap()


# Numbers of a vector, as many as this processor multiplies at once (AVX-512, or 256 bits); vectors side by side.
LANES = 16 if _host_features().get("avx512f") else 8
VECTORS = 16 // LANES
FLOAT_BYTES = 4
FLOAT, INT, INT32, BYTE, POINTER = ir.FloatType(), ir.IntType(64), ir.IntType(32), ir.IntType(8), ir.PointerType()
VECTOR = ir.VectorType(FLOAT, LANES)
MULTIPLY_ADD = f"llvm.fmuladd.v{LANES}f32"

Value = Any  # of LLVM's intermediate representation
Write = Callable[..., None]  # of the code, and of the arguments' and the results' arrays: writes what is done

_engines: list[binding.ExecutionEngine] = []  # machine code lives as long as they do


def compile_and_register(functions: dict[str, tuple[Write, int, int]]) -> None:
    """Makes functions what programs on the CPU call.

    Args:
        functions: by the names under which XLA calls them: what writes one, how many arguments and how many results
            it has.
    """
    module = ir.Module()
    for target, (write, num_arguments, num_results) in functions.items():
        _define_handler(module, target, write, num_arguments, num_results)
    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    processor, features = binding.get_host_cpu_name(), _host_features().flatten()
    machine = binding.Target.from_default_triple().create_target_machine(processor, features, opt=3)
    code = binding.parse_assembly(str(module))
    passes = binding.create_pass_builder(machine, binding.PipelineTuningOptions(speed_level=3))
    passes.getModulePassManager().run(code, passes)
    engine = binding.create_mcjit_compiler(code, machine)
    engine.finalize_object()
    _engines.append(engine)
    for target in functions:
        address = ctypes.c_void_p(engine.get_function_address(target))
        jax.ffi.register_ffi_target(target, jax.ffi.pycapsule(address), platform="cpu")


@dataclass
class Loop:
    """A loop while it is written."""

    index: Value
    values: list[Value]  # that pass from one round to the next: set the next round's inside, read the last one's after


class Code:
    """The body of a function while it is written. Whole numbers are 64 bit, or Python's."""

    def __init__(self, function: ir.Function):
        self.builder = ir.IRBuilder(function.append_basic_block())
        self.module = function.module

    def sum(self, *numbers: Value) -> Value:
        """Of whole numbers."""
        return functools.reduce(self.builder.add, map(whole, numbers))

    def product(self, *numbers: Value) -> Value:
        """Of whole numbers."""
        return functools.reduce(self.builder.mul, map(whole, numbers))

    def at(self, start: Value, *offsets: Value) -> Value:
        """The address of a float32 number so far behind the one at ``start``."""
        return self.builder.gep(start, [self.sum(*offsets)], source_etype=FLOAT)

    def field(self, structure: Value, offset: int, kind: ir.Type = POINTER) -> Value:
        """What a structure holds at an offset in bytes."""
        return self.builder.load(self.address(structure, offset), typ=kind)

    def address(self, structure: Value, offset: int) -> Value:
        """Of a structure's field."""
        return self.builder.gep(structure, [whole(offset)], source_etype=BYTE)

    @contextmanager
    def loop(self, start: Value, stop: Value, step: int = 1, values: Sequence[Value] = ()) -> Iterator[Loop]:
        """What is written inside is done for every index of ``range(start, stop, step)``."""
        builder = self.builder
        before, head = builder.block, builder.append_basic_block()
        inside, after = builder.append_basic_block(), builder.append_basic_block()
        builder.branch(head)
        builder.position_at_end(head)
        first = [whole(start), *values]
        current = [builder.phi(value.type) for value in first]
        builder.cbranch(builder.icmp_signed("<", current[0], whole(stop)), inside, after)
        builder.position_at_end(inside)
        loop = Loop(current[0], current[1:])
        yield loop
        following = [self.sum(current[0], step), *loop.values]
        for variable, value, next_value in zip(current, first, following, strict=True):
            variable.add_incoming(value, before)
            variable.add_incoming(next_value, builder.block)
        builder.branch(head)
        builder.position_at_end(after)
        loop.values = current[1:]

    def blocks(self, total: Value, sizes: Sequence[int]) -> Iterator[tuple[Value, Value, int]]:
        """(start, stop, size): ``range(total)`` in steps of the first size while it fits, then of the next."""
        start = whole(0)
        for size in sizes:
            count = self.builder.sdiv(self.sum(total, self.product(start, -1)), whole(size))
            stop = self.sum(start, self.product(count, size))
            yield start, stop, size
            start = stop

    def smaller(self, one: Value, other: Value) -> Value:
        """Of two whole numbers."""
        return self.builder.select(self.builder.icmp_signed("<", one, whole(other)), one, whole(other))

    def larger(self, one: Value, other: Value) -> Value:
        """Of two whole numbers."""
        return self.builder.select(self.builder.icmp_signed(">", one, whole(other)), one, whole(other))

    def data(self, array: Value) -> Value:
        """The address of the first number of one of XLA's arrays."""
        return self.field(array, ffi.Buffer.data.offset)

    def shape(self, array: Value) -> list[Value]:
        """Of an array with four axes."""
        dims = self.field(array, ffi.Buffer.dims.offset)
        return [self.field(dims, i * ctypes.sizeof(ctypes.c_int64), INT) for i in range(4)]

    def vectors(self, start: Value) -> list[Value]:
        """``VECTORS`` vectors that lie side by side."""
        return [self.builder.load(self.at(start, v * LANES), typ=VECTOR, align=FLOAT_BYTES) for v in range(VECTORS)]

    def put_vectors(self, vectors: Sequence[Value], start: Value) -> None:
        """Writes them side by side."""
        for v, vector in enumerate(vectors):
            self.builder.store(vector, self.at(start, v * LANES), align=FLOAT_BYTES)

    def add_outer(self, sums: list[Value], scalars: Sequence[Value], vectors: Sequence[Value]) -> list[Value]:
        """``sums`` (scalars x vectors) plus the outer product of numbers at the addresses ``scalars`` with vectors."""
        changed = []
        for i, address in enumerate(scalars):
            number = self.builder.load(address, typ=FLOAT)
            lane = self.builder.insert_element(ir.Constant(VECTOR, ir.Undefined), number, INT32(0))
            same = self.builder.shuffle_vector(lane, lane, ir.Constant(ir.VectorType(INT32, LANES), [0] * LANES))
            for v, vector in enumerate(vectors):
                changed.append(self.call(MULTIPLY_ADD, VECTOR, same, vector, sums[i * len(vectors) + v]))
        return changed

    def call(self, name: str, result: ir.Type, *arguments: Value) -> Value:
        """A function of the C library, or one of LLVM's own."""
        known = self.module.globals.get(name)
        kind = ir.FunctionType(result, [argument.type for argument in arguments])
        return self.builder.call(known or ir.Function(self.module, kind, name), arguments)


def _define_handler(module: ir.Module, target: str, write: Write, num_arguments: int, num_results: int) -> None:
    """What XLA calls: answers which version of its interface this is, or finds the arrays and does the work.

    It always succeeds: who writes the call sees to shapes and dtypes.
    """
    handler = ir.Function(module, ir.FunctionType(POINTER, [POINTER]), target)
    code, frame = Code(handler), handler.args[0]
    builder, success = code.builder, ir.Constant(POINTER, None)
    extension = code.field(frame, ffi.CallFrame.extension_start.offset)
    with builder.if_then(builder.icmp_unsigned("!=", extension, success), likely=False):
        kind = code.field(extension, ffi.Extension.type.offset, INT32)
        with builder.if_then(builder.icmp_signed("==", kind, INT32(ffi.METADATA_EXTENSION))):
            metadata = code.field(extension, ffi.MetadataExtension.metadata.offset)
            version = ffi.Metadata.version.offset
            for offset, number in (
                (version + ffi.Version.major.offset, ffi.API_MAJOR),
                (version + ffi.Version.minor.offset, ffi.API_MINOR),
                (ffi.Metadata.traits.offset, 0),
            ):
                builder.store(INT32(number), code.address(metadata, offset))
            builder.ret(success)

    def arrays(list_offset: int, count: int) -> list[Value]:
        """The frame's arguments, or results."""
        pointers = code.field(frame, list_offset + ffi.Buffers.buffers.offset)
        return [code.field(pointers, i * ctypes.sizeof(ctypes.c_void_p)) for i in range(count)]

    write(
        code,
        *arrays(ffi.CallFrame.arguments.offset, num_arguments),
        *arrays(ffi.CallFrame.results.offset, num_results),
    )
    builder.ret(success)


def whole(number: Value) -> Value:
    """A whole number as a value."""
    return INT(number) if isinstance(number, int) else number
