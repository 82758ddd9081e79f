"""Another participant of a virtual bus."""

import can


class Chatter:
    """Sends the same frames periodically; the first time after one period."""

    def __init__(self, bus: can.BusABC, *frames: tuple[int, bytes], period_s: float = 0.1) -> None:
        self.bus, self.frames, self.period_s, self.due_s = bus, frames, period_s, period_s

    def next_event_s(self) -> float:
        return self.due_s

    def poll(self, now_s: float) -> None:
        while self.bus.recv(0) is not None:
            pass
        if now_s >= self.due_s:
            self.due_s = now_s + self.period_s
            for can_id, data in self.frames:
                self.bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
