"""Demo worlds made of splats: a yard, a greenhouse, a city, a robot that drives."""
