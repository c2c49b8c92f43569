"""The faster chunk builder writes the very bytes of mcap's own."""

import io

from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer

from rt_runner.mcap_chunk import speed_up

MESSAGE = st.tuples(
    st.integers(0, 2), st.integers(0, 2**63), st.binary(max_size=40), st.integers(0, 2**63), st.integers(0, 2**32 - 1)
)


def written(messages, fast: bool) -> bytes:
    out = io.BytesIO()
    writer = Writer(out, chunk_size=200, compression=CompressionType.NONE)
    assert not fast or speed_up(writer), "a new version of mcap has its builder in another place"
    writer.start(profile="", library="x")
    schema = writer.register_schema("s", "protobuf", b"")
    channels = [writer.register_channel(f"c{n}", "protobuf", schema) for n in range(3)]
    for channel, log_ns, data, publish_ns, sequence in messages:
        writer.add_message(channels[channel], log_ns, data, publish_ns, sequence)
    writer.finish()
    return out.getvalue()


@settings(max_examples=60, deadline=None)
@given(st.lists(MESSAGE, max_size=30))
def test_the_same_bytes(messages):
    assert written(messages, True) == written(messages, False)
