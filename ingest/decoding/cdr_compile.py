"""Message definitions compiled to column operations."""

from __future__ import annotations

from collections.abc import Collection, Iterable

import numpy as np

from restock.ingest.decoding.cdr_fixed_fields import FixedField, FixedFields
from restock.ingest.decoding.cdr_plan import CdrPlan, Primitives, Repeat, Text
from restock.ingest.decoding.definitions import TIMES, RosType
from restock.ingest.decoding.field_paths import DTYPES, CannotDecode, FieldType


class _Compiler:
    """Walks a definition and collects its operations."""

    def __init__(self, message: RosType, wanted: Collection[str], ros1: bool) -> None:
        self.message, self.wanted, self.ros1 = message, wanted, ros1

    def plan(self, name: str, prefix: str) -> CdrPlan:
        """The plan of a message whose fields' paths start with `prefix`."""
        plan = CdrPlan([], {})
        fixed: list[FixedField] = []
        self._message(name, prefix, plan, fixed)
        self._close(plan, fixed)
        return plan

    def _close(self, plan: CdrPlan, fixed: list[FixedField]) -> None:
        if fixed:
            plan.operations.append(FixedFields(list(fixed)))
            fixed.clear()

    def _message(self, name: str, prefix: str, plan: CdrPlan, fixed: list[FixedField]) -> None:
        fields = self.message.fields_of(name)
        if not fields and not self.ros1:  # C and C++ have no empty structure: it holds one byte
            fixed.append(FixedField(np.dtype(np.uint8), None, 1, None))
        for part in fields:
            self._field(part, prefix + part.name, plan, fixed)

    def _field(self, part: FieldType, path: str, plan: CdrPlan, fixed: list[FixedField]) -> None:
        wanted = self._wanted(path)
        if part.base and part.base != "string":
            dtype = DTYPES[part.base]
            if part.many is None or part.many.length is not None:
                count = part.many.length if part.many else None
                fixed.append(FixedField(dtype, count, 1 if self.ros1 else dtype.itemsize, wanted))
                self._note(plan, wanted, part.base, () if count is None else (count,))
                return
            self._close(plan, fixed)
            plan.operations.append(Primitives(dtype, wanted, self.ros1))
            self._note(plan, wanted, part.base, (None,))
        elif part.many:
            self._repeat(part, path, plan, fixed)
        elif part.base:
            self._close(plan, fixed)
            plan.operations.append(Text(wanted, self.ros1))
            self._note(plan, wanted, "string", ())
        elif part.message in TIMES:
            self._time(str(part.message), path, ".", plan, fixed)
        else:
            self._message(str(part.message), path + ".", plan, fixed)

    def _repeat(self, part: FieldType, path: str, plan: CdrPlan, fixed: list[FixedField]) -> None:
        length = part.many.length if part.many else None
        self._close(plan, fixed)
        if part.base:
            wanted = self._wanted(path)
            inner = CdrPlan([Text(wanted, self.ros1)], {})
            self._note(inner, wanted, "string", ())
        elif part.message in TIMES:
            inner, inner_fixed = CdrPlan([], {}), list[FixedField]()
            self._time(str(part.message), path, "[].", inner, inner_fixed)
            self._close(inner, inner_fixed)
        else:
            inner = self.plan(str(part.message), path + "[].")
        if inner.operations or length is None:
            plan.operations.append(Repeat(inner, length, self.ros1))
        for inner_path, (kind, dims) in inner.paths.items():
            plan.paths[inner_path] = (kind, (length, *dims))

    def _time(self, name: str, path: str, dot: str, plan: CdrPlan, fixed: list[FixedField]) -> None:
        """Its two fields; wanted as nanoseconds of both, or each by its own path, or all."""
        fields = self.message.fields_of(name)
        bases = [field.base for field in fields]
        if len(fields) != 2 or not all(base in ("int32", "uint32") for base in bases):
            raise CannotDecode(f"{name} is not the standard definition of a time")
        whole = self._wanted(path)
        for part, one in zip(("sec", "nanosec"), fields, strict=True):
            dtype = DTYPES[str(one.base)]
            align = 1 if self.ros1 else 4
            part_path = self._wanted(path + dot + one.name)
            if whole is not None:
                fixed.append(FixedField(dtype, None, align, whole, part, part_path))
            else:
                fixed.append(FixedField(dtype, None, align, part_path))
            self._note(plan, part_path, str(one.base), ())
        self._note(plan, whole, "time", ())

    def _wanted(self, path: str) -> str | None:
        return path if path in self.wanted else None

    def _note(
        self, plan: CdrPlan, wanted: str | None, kind: str, dims: tuple[int | None, ...]
    ) -> None:
        if wanted is not None:
            plan.paths[wanted] = (kind, dims)


def compile_plan(message: RosType, wanted: Iterable[str], *, ros1: bool = False) -> CdrPlan:
    """The plan that reads these leaf paths of a message type (each as `Leaf.path` gives it).

    Raises:
        CannotDecode: the type uses something unsupported.
    """
    return _Compiler(message, frozenset(wanted), ros1).plan(message.name, "")
