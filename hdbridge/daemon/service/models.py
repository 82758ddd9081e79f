"""Model that compensates an axis: the model chosen by clients and the model used by the control process.

They differ after a restart of the control process. `AxisModels.in_use` follows the acknowledgement of the
control process, so clients never see a model that is not in effect. While `AxisModels.settled` is False, the
service sends the chosen setting again.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from datetime import datetime
from typing import TYPE_CHECKING, Literal

from hdbridge.axis import Identity
from hdbridge.axis.model import TransmissionModel, store
from hdbridge.daemon.setting import CompensationSetting
from hdbridge.enums import Scheme
from hdbridge.errors import InputError

if TYPE_CHECKING:
    from hdbridge.daemon.machine import Axis
    from hdbridge.daemon.memory.cells import SettingSlot


class AxisModels:
    """Models of one axis."""

    def __init__(self, axis: Axis, slot: SettingSlot) -> None:
        """Adopts the setting sent by an earlier service, else chooses the active model."""
        self._axis = axis
        self._slot = slot
        self._sent: dict[int, CompensationSetting] = {}
        self._none = CompensationSetting(TransmissionModel(axis.config.gear.ratio), Scheme.NONE)
        with suppress(InputError):
            self._sent[slot.number] = CompensationSetting.from_json(slot.get(slot.number))
        self.chosen = self._sent.get(slot.number) or self._active()
        """Setting that the axis is to use."""

    @property
    def in_use(self) -> CompensationSetting:
        """Setting that the control process uses; uncompensated before the first."""
        return self._sent.get(self._slot.in_use, self._none)

    @property
    def settled(self) -> bool:
        """True if the control process uses the chosen setting and no other is being sent."""
        number = self._slot.in_use
        return self._slot.number == number and self._sent.get(number) is self.chosen

    def send(self, setting: CompensationSetting) -> int:
        """Stores a setting for the control process; returns the argument of CHANGE."""
        number = self._slot.put(setting.to_json())
        in_use = self._slot.in_use
        self._sent = {in_use: self._sent.get(in_use, self._none), number: setting}
        return number

    def check_drive(self, identity: Identity) -> None:
        """Raises InputError if the chosen model belongs to another drive than ``identity``."""
        self.chosen.model.check_bound_to(self._axis.config, identity)

    def with_scheme(self, scheme: Scheme) -> CompensationSetting:
        """Returns the chosen setting with another scheme. Raises InputError without a model."""
        if scheme is Scheme.EXTENDED and not self.chosen.model.effects:
            raise InputError(
                f"{self._axis.name}: there is no model to compensate with; calibrate first, or use 'none'"
            )
        return self._checked(replace(self.chosen, scheme=scheme))

    def with_load_loop(self, on: bool) -> CompensationSetting:
        """Returns the setting with the load loop on or off. Raises InputError without a load loop."""
        if self._axis.load_loop is None:
            raise InputError(f"{self._axis.name}: has no load loop; give the axis one in the machine file")
        return replace(self.chosen, load_loop=on)

    def found(self, version: int | Literal["pending", "active"], identity: Identity) -> CompensationSetting:
        """Returns the setting of another model of the profile, with the current scheme.

        Raises InputError if the model does not exist, or belongs to another axis, drive or gear.
        """
        found = store.find(self._axis.profile.folder, str(version))
        found.content.check_bound_to(self._axis.config, identity)
        return self._checked(
            replace(self.chosen, model=found.content, version=found.number, file=found.path, adapted=None)
        )

    def activate(
        self, version: int | Literal["pending", "active"], identity: Identity, date: datetime
    ) -> None:
        """Makes the model in use, found by `found` under ``version``, the active model of the profile."""
        folder, number = self._axis.profile.folder, self.chosen.version
        if version == store.PENDING:
            number = store.commit(folder, date, identity)
        elif version != store.ACTIVE and not store.find(folder, str(version)).active:
            number = store.activate(folder, int(version), "through the daemon", date, identity)
        self.chosen = replace(self.chosen, version=number, file=self._axis.profile.model)

    def _checked(self, setting: CompensationSetting) -> CompensationSetting:
        setting.compensation(self._axis.config)
        return setting

    def _active(self) -> CompensationSetting:
        """Returns the setting with the active model, its version and the machine file's scheme."""
        axis = self._axis
        number = None
        if axis.profile.model.exists():
            number = store.find(axis.profile.folder, store.ACTIVE).number
        load_loop = axis.load_loop is not None
        return CompensationSetting(axis.model(), axis.compensation, number, axis.profile.model, load_loop)
