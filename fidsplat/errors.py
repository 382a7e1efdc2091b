"""The two kinds of error that a user meets; the command line turns them into one line and an exit status."""


class FidsplatError(Exception):
    """Base of every error that fidsplat raises on purpose; its text says what was wrong and what would be
    right."""

    exit_status = 1


class InputError(FidsplatError, ValueError):
    """The user's input (file, spec, pose, size, option) cannot be used. Exit status 2."""

    exit_status = 2


class DeviceError(FidsplatError, RuntimeError):
    """A device is missing, unknown, or failed while it ran. Exit status 1 (2 for an unknown name)."""

    exit_status = 1


class UnknownDeviceError(DeviceError):
    """The name of a device that nothing here answers to."""

    exit_status = 2
