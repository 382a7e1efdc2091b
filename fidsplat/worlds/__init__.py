"""Demo worlds made of splats: a greenhouse, a city, a robot that drives."""
