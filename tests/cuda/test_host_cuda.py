# SPDX-License-Identifier: Apache-2.0
"""The current stream of a device, as torch names it."""

import torch

from blitzgs.ops.host import current_stream


def test_the_current_stream_is_torchs_and_its_object_is_made_once():
    device, other = torch.device("cuda", torch.cuda.current_device()), torch.cuda.Stream()
    for stream in (torch.cuda.default_stream(), other, torch.cuda.ExternalStream(other.cuda_stream)):
        with torch.cuda.stream(stream):
            found = current_stream(device)
            assert found == torch.cuda.current_stream() and found.cuda_stream == stream.cuda_stream
            assert current_stream(device) is found and current_stream(torch.device("cuda")) is found


def test_an_event_on_the_current_stream_waits_for_its_work():
    event, side = torch.cuda.Event(), torch.cuda.Stream()
    values = torch.zeros(1 << 20, device="cuda")
    values += 0  # loads the kernel, which may take longer than the sleep
    torch.cuda.synchronize()
    with torch.cuda.stream(side):
        torch.cuda._sleep(1_000_000_000)  # longer than a busy host needs for the next lines
        values += 1
        event.record(current_stream(values.device))
    assert not event.query()
    event.synchronize()
    assert values.min() == 1
