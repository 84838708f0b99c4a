"""Columns of ROS messages by rosbags, message by message: what the columnar decoder must give."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces.typing import Typesdict
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_typestore
from rosbags.typesys.base import normalize_fieldname

from restock.ingest.decoding.columns import DTYPES, CannotDecode, FieldType, Leaf
from restock.ingest.decoding.definitions import RosType
from restock.ingest.decoding.row_by_row import ParsedDecoder, Unparsable, objects


class RowDecoder(ParsedDecoder):
    """Decodes each ROS message with rosbags' generated code.

    Raises:
        CannotDecode: rosbags refuses the definition.
    """

    def __init__(self, message: RosType, leaves: Sequence[Leaf], *, ros1: bool = False) -> None:
        super().__init__(_RosParser(message, ros1), leaves)


class _RosParser:
    def __init__(self, message: RosType, ros1: bool) -> None:
        self._name = message.name
        try:
            store = get_typestore(Stores.EMPTY)
            store.register(_family(message))
        except (TypesysError, SyntaxError, KeyError, RecursionError) as error:
            raise CannotDecode(f"its definition cannot be used: {error}") from error
        self._read = store.deserialize_ros1 if ros1 else store.deserialize_cdr

    def parse(self, payload: bytes) -> Any:
        try:
            return self._read(payload, self._name)
        except (SerdeError, IndexError, ValueError, KeyError) as error:
            raise Unparsable(str(error).split(":")[0]) from error

    def member(self, message: Any, field: FieldType) -> Any:
        return getattr(message, normalize_fieldname(field.name))

    def stamp_ns(self, value: Any) -> int:
        return int(value.sec * 1_000_000_000 + value.nanosec)

    def array(self, values: Sequence[Any], leaf: Leaf) -> NDArray[Any]:
        if leaf.kind == "string":
            return objects(values)
        if leaf.kind == "byte":  # an octet; rosbags gives it a sign
            return np.array(values, np.int8).view(np.uint8)
        return np.array(values, DTYPES[leaf.kind])

    def concatenate(self, values: Sequence[Any], leaf: Leaf) -> NDArray[Any]:
        dtype = DTYPES[leaf.kind]
        parts = [np.asarray(value, dtype) for value in values]
        return np.concatenate(parts) if parts else np.zeros(0, dtype)


def _family(message: RosType) -> Typesdict:
    """Return the type and those it contains: all that rosbags must compile."""
    wanted: list[str] = [message.name]
    family: Typesdict = {}
    while wanted:
        name = wanted.pop()
        if name not in family:
            fields = message.fields_of(name)
            family[name] = message.raw[name]
            wanted += [field.message for field in fields if field.message]
    return family
