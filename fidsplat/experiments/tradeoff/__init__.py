"""What accuracy costs in time: every knob of `Quality` alone and in combinations, on named scenes."""
