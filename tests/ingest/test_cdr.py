"""The columnar decoder agrees with rosbags for any definition and byte order."""

from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from support.bag_samples import STORE
from support.rosbags_columns import RowDecoder

from restock.ingest.decoding.columns import CannotDecode, Channel, MessageBatch, equal
from restock.ingest.decoding.decoders import ColumnDecoder
from restock.ingest.decoding.definitions import RosType, message_type

PRIMITIVES = [
    *("bool", "byte", "char", "int8", "uint8", "int16", "uint16", "int32", "uint32"),
    *("int64", "uint64", "float32", "float64"),
]
REPEATS = ["", "", "", "[]", "[]", "[<=5]", "[3]", "[1]"]


def batch(payloads: list[bytes], lead: int = 3) -> MessageBatch:
    """Return a batch of payloads at odd offsets of one buffer, as in a chunk."""
    padded = [b"\xaa" * lead + payload for payload in payloads]
    whole = MessageBatch.of(padded, np.arange(len(payloads)), np.arange(len(payloads)))
    return MessageBatch(
        whole.buffer, whole.start + lead, whole.stop, whole.log_time_ns, whole.log_time_ns
    )


def assert_agrees_with_rosbags(
    message: RosType, payloads: list[bytes], *, ros1: bool = False
) -> None:
    leaves = message.leaves()
    messages = batch(payloads)
    columnar = ColumnDecoder(message, leaves, ros1=ros1).decode(messages)
    rosbags = RowDecoder(message, leaves, ros1=ros1).decode(messages)
    assert columnar.bad == rosbags.bad == {}
    assert np.array_equal(columnar.rows, rosbags.rows)
    assert columnar.fields.keys() == rosbags.fields.keys()
    for path, column in rosbags.fields.items():
        assert equal(columnar.fields[path], column), path
    for leaf in leaves:  # each leaf alone, so that the others are skipped over
        alone = ColumnDecoder(message, [leaf], ros1=ros1).decode(messages)
        assert equal(alone.fields[leaf.path], rosbags.fields[leaf.path]), leaf.path


# -- generated definitions ------------------------------------------------------------------


@st.composite
def definitions(draw: st.DrawFn, *, ros1: bool = False) -> str:
    """Return a message definition with its nested definitions, as a recording carries it."""
    bounds = "[]" if ros1 else "[<=5]"  # ROS 1 has no bounded arrays
    repeats = [bounds if repeat == "[<=5]" else repeat for repeat in REPEATS]
    others = ["time", "duration"] if ros1 else ["string<=8", "builtin_interfaces/Time"]
    count = draw(st.integers(1, 4))
    texts = []
    for number in range(count):
        inner = [f"pkg/T{other}" for other in range(number + 1, count)]
        kinds = [*PRIMITIVES, "string", *others, *inner * 3]
        fields = draw(
            st.lists(st.tuples(st.sampled_from(kinds), st.sampled_from(repeats)), max_size=6)
        )
        lines = [f"{kind}{repeat} f{place}" for place, (kind, repeat) in enumerate(fields)]
        texts.append("\n".join(lines) or "# nothing in it")
    rule = "\n" + "=" * 80 + "\nMSG: "
    time = "int32 sec\nuint32 nanosec"
    family = [f"pkg/T{number}\n{text}" for number, text in enumerate(texts)][1:]
    return rule.join([texts[0], *family, *([] if ros1 else [f"builtin_interfaces/Time\n{time}"])])


class MessageGenerator:
    """Generator of random messages of a definition, with varied lengths."""

    def __init__(self, store: Any, rng: np.random.Generator, longest: int) -> None:
        self.store, self.rng, self.longest = store, rng, longest

    def message(self, name: str) -> Any:
        values = [self.value(description) for _, description in self.store.fielddefs[name][1]]
        return self.store.types[name](*values)

    def value(self, description: Any) -> Any:
        node, rest = int(description[0]), description[1]
        if node == 1:
            return self.base(rest[0])
        if node == 2:
            return self.message(rest)
        (inner, what), bound = rest
        length = bound if node == 3 else int(self.rng.integers(0, (bound or self.longest) + 1))
        if inner == 1 and what[0] != "string":
            return np.array([self.base(what[0]) for _ in range(length)], self.dtype(what[0]))
        return [self.value((inner, what)) for _ in range(length)]

    def dtype(self, base: str) -> Any:
        return {"byte": np.int8, "char": np.uint8, "bool": np.bool_}.get(base) or np.dtype(base)

    def base(self, base: str) -> Any:
        if base == "string":
            letters = self.rng.integers(0, 4, self.rng.integers(0, 6)).tolist()
            return "".join("aé\U0001f916 "[letter] for letter in letters)
        if base == "bool":
            return bool(self.rng.integers(2))
        if base.startswith("float"):
            special = [0.0, -1.5, np.inf, -np.inf, np.nan, 1e-30, 3.25]
            return float(np.dtype(base).type(special[self.rng.integers(7)]))
        info = np.iinfo(self.dtype(base))
        return int(self.rng.integers(info.min, info.max, dtype=self.dtype(base), endpoint=True))


@settings(max_examples=150, suppress_health_check=list(HealthCheck))
@given(
    text=definitions(),
    seed=st.integers(0, 2**32),
    rows=st.integers(1, 12),
    longest=st.sampled_from([0, 1, 3, 9]),
    little=st.booleans(),
    alike=st.booleans(),
)
def test_random_definition_decodes_like_rosbags(text, seed, rows, longest, little, alike):
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(text, "pkg/msg/T0"))
    message = message_type(
        Channel(1, "/t", "pkg/msg/T0", "cdr", "ros2msg", text.encode()), "humble"
    )
    generator = MessageGenerator(store, np.random.default_rng(seed), longest)
    generated = [generator.message("pkg/msg/T0") for _ in range(1 if alike else rows)]
    payloads = [
        bytes(store.serialize_cdr(item, "pkg/msg/T0", little_endian=little)) for item in generated
    ] * (rows if alike else 1)
    assert_agrees_with_rosbags(message, payloads)


@settings(max_examples=100, suppress_health_check=list(HealthCheck))
@given(
    text=definitions(ros1=True),
    seed=st.integers(0, 2**32),
    rows=st.integers(1, 12),
    longest=st.sampled_from([0, 1, 3, 9]),
    alike=st.booleans(),
)
def test_random_ros1_definition_decodes_like_rosbags(text, seed, rows, longest, alike):
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(text, "pkg/msg/T0"))
    channel = Channel(1, "/t", "pkg/T0", "ros1", "ros1msg", text.encode())
    generator = MessageGenerator(store, np.random.default_rng(seed), longest)
    generated = [generator.message("pkg/msg/T0") for _ in range(1 if alike else rows)]
    payloads = [bytes(store.serialize_ros1(item, "pkg/msg/T0")) for item in generated]
    assert_agrees_with_rosbags(
        message_type(channel, "humble"), payloads * (rows if alike else 1), ros1=True
    )


def test_batch_with_both_byte_orders():
    message = message_type(Channel(1, "/t", "nav_msgs/msg/Path", "cdr"), "humble")
    types = STORE.types
    payloads = []
    for row in range(9):
        stamp = types["builtin_interfaces/msg/Time"](row, 5)
        header = types["std_msgs/msg/Header"](stamp, "f" * row)
        pose = types["geometry_msgs/msg/Pose"](
            types["geometry_msgs/msg/Point"](1.0 * row, 2.0, 3.0),
            types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
        )
        poses = [types["geometry_msgs/msg/PoseStamped"](header, pose) for _ in range(row)]
        path = types["nav_msgs/msg/Path"](header, poses)
        little = row % 2 == 0
        payloads.append(bytes(STORE.serialize_cdr(path, "nav_msgs/msg/Path", little_endian=little)))
    assert_agrees_with_rosbags(message, payloads)


# -- golden bytes ---------------------------------------------------------------------------


def ros_type(kind: str, definition: str = "") -> RosType:
    form = "ros2msg" if definition else ""
    return message_type(Channel(1, "/t", kind, "cdr", form, definition.encode()), "humble")


def test_xcdr2_and_parameter_lists_are_rejected():
    message = ros_type("std_msgs/msg/Bool")
    good, xcdr2 = bytes.fromhex("0001000001"), bytes.fromhex("0007000001")
    decoded = ColumnDecoder(message, message.leaves()).decode(
        batch([good, xcdr2, xcdr2, b"\0\3\0\0"])
    )
    assert decoded.rows.tolist() == [0]
    assert decoded.bad == {
        "serialised as XCDR2, 00 07: not supported": 2,
        "serialised as a parameter list (PL_CDR), 00 03: not supported": 1,
    }


def test_missized_messages_are_counted_and_others_kept():
    message = ros_type("std_msgs/msg/String")
    rows = [bytes(STORE.serialize_cdr(STORE.types[message.name](t), message.name)) for t in "abc"]
    rows[1:1] = [rows[0][:-1], rows[0] + b"\0\0\0\0", b"\0\1", b"\0\1\0\0\xff\xff\xff\xff"]
    decoded = ColumnDecoder(message, message.leaves()).decode(batch(rows))
    assert decoded.fields["data"].tolist() == ["a", "b", "c"]
    assert decoded.rows.tolist() == [0, 5, 6]
    assert decoded.bad == {
        "mis-sized: it ends before its last field": 2,
        "mis-sized: bytes are left after its last field": 1,
        "mis-sized: shorter than its header": 1,
    }


def test_invalid_text_is_counted():
    message = ros_type("std_msgs/msg/String")
    rows = [
        bytes.fromhex("00010000 02000000 ff00"),
        bytes.fromhex("00010000 02000000 6161"),
        bytes.fromhex("00010000 02000000 6100"),
    ]
    decoded = ColumnDecoder(message, message.leaves()).decode(batch(rows))
    assert decoded.fields["data"].tolist() == ["a"]
    assert decoded.bad == {
        "text that is not valid UTF-8": 1,
        "text without its terminating zero": 1,
    }


@pytest.mark.parametrize(
    ("definition", "message"),
    [
        ("wstring name", "wstring"),
        ("pkg/Missing inner", "not defined"),
        ("uint8[0] none", "array of 0"),
        ("uint8[99999999] much", "array of 99,999,999"),
        ("pkg/T again", "nests deeper"),
        ("=this is no definition", "cannot be parsed"),
    ],
)
def test_undecodable_definition_is_reported(definition, message):
    with pytest.raises(CannotDecode, match=message):
        ros_type("pkg/msg/T", definition)


def test_every_damaged_row_is_counted():
    message = ros_type("diagnostic_msgs/msg/DiagnosticArray")
    rng = np.random.default_rng(3)
    rows = [
        b"\0\1\0\0" + rng.integers(0, 3, rng.integers(0, 90)).astype(np.uint8).tobytes()
        for _ in range(400)
    ]
    decoded = ColumnDecoder(message, message.leaves()).decode(batch(rows))
    assert len(decoded.rows) + sum(decoded.bad.values()) == 400
    assert decoded.bad
