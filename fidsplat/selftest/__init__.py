"""Self-test: hard cases of splat rendering, run on a device by tests and by `fidsplat check`."""
