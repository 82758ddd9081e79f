"""Messages follow the schema in the file, as protobuf's own library reads it."""

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from support.flight import samples

from hdbridge.daemon.memory import AXIS_SAMPLE
from hdbridge.daemon.recorder.wire import AXIS, MACHINE, axis_messages, machine_messages
from hdbridge.errors import InputError


def message_class(message):
    pool = DescriptorPool()
    for file in FileDescriptorSet.FromString(message.schema).file:
        pool.Add(file)
    return GetMessageClass(pool.FindMessageTypeByName(message.name))


def test_protobuf_reads_every_field_of_an_axis():
    made = samples(50, axes=2)
    made["axes"]["fault"][:10] = 3
    kind = message_class(AXIS)
    for row, data in zip(made, axis_messages(made, 1), strict=True):
        read = kind.FromString(data)
        assert read.cycle == row["cycle"]
        for name in AXIS_SAMPLE.names:
            assert getattr(read, name) == row["axes"][1][name], name


def test_protobuf_reads_every_field_of_the_machine():
    made = samples(20)
    kind = message_class(MACHINE)
    for row, data in zip(made, machine_messages(made), strict=True):
        read = kind.FromString(data)
        for field in kind.DESCRIPTOR.fields:
            assert getattr(read, field.name) == row[field.name]


def test_states_have_names():
    kind = message_class(AXIS)
    names = kind.DESCRIPTOR.fields_by_name["state"].enum_type.values_by_number
    assert names[3].name == "STATE_ENABLED"
    assert kind.DESCRIPTOR.fields_by_name["fault"].enum_type.values_by_number[255].name == "FAULT_NONE"


def test_messages_are_decoded_exactly():
    made = samples(30)
    made["axes"]["issued_deg"][5] = np.nan
    made["axes"]["state"] = np.arange(30)[:, None] * 8 % 256
    back = AXIS.decode(axis_messages(made, 0))
    for name in AXIS_SAMPLE.names:
        np.testing.assert_array_equal(back[name], made["axes"][name][:, 0])


def test_messages_of_another_layout_are_refused():
    data = axis_messages(samples(2), 0)
    for wrong in (data[0][:-1], b"\x12" + data[0][1:]):
        with pytest.raises(InputError, match="another release"):
            AXIS.decode([data[1], wrong])
