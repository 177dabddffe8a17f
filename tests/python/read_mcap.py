"""Decodes every message of an MCAP file from the schema in the file alone and prints what it found as JSON.

Needs the packages mcap and mcap-protobuf-support; knows nothing of dragfree.
"""

import json
import sys

from mcap.reader import make_reader
from mcap.records import Channel
from mcap.stream_reader import StreamReader
from mcap_protobuf.decoder import DecoderFactory


def leaves(message, path=""):
    """Scalars of a message with their dotted paths, nested messages walked, unset scalars as their default."""
    for field in message.DESCRIPTOR.fields:
        value, name = getattr(message, field.name), f"{path}{field.name}"
        if field.message_type is not None:
            yield from leaves(value, name + ".")
        else:
            yield name, value


def channels(path):
    """Every channel that the file defines, read from its records, summary or not."""
    with open(path, "rb") as stream:
        return {record.id: record for record in StreamReader(stream).records if isinstance(record, Channel)}.values()


def main(path):
    topics = {}
    with open(path, "rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
        # Topics of other encodings, a debug channel in JSON, are not for this reader.
        protobuf = [c.topic for c in channels(path) if c.message_encoding == "protobuf"]
        for schema, channel, message, decoded in reader.iter_decoded_messages(topics=protobuf):
            topic = topics.setdefault(
                channel.topic,
                {"schema": schema.name, "metadata": channel.metadata, "count": 0, "first_ns": message.log_time}
                | {"sums": {}, "missing": {}},
            )
            topic["count"] += 1
            topic["last_ns"] = message.log_time
            for name, value in leaves(decoded):
                if value != value:  # NaN is no value
                    topic["missing"][name] = topic["missing"].get(name, 0) + 1
                else:
                    topic["sums"][name] = topic["sums"].get(name, 0.0) + value
    json.dump({"metadata": metadata, "topics": topics}, sys.stdout)


main(sys.argv[1])
