"""The errors of the plant: each message says what, where, and what to do."""


class PlantError(Exception):
    """Root of all errors that the plant raises on purpose."""


class ParameterError(PlantError):
    """A physical parameter is missing, unknown or impossible."""


class CycleError(PlantError):
    """A driving cycle cannot be read or built."""


class PlantStateError(PlantError):
    """The plant was asked for something that its state does not allow."""


class FaultError(PlantError):
    """A sensor fault is not understood, impossible, or in conflict with another one."""
