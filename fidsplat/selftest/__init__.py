"""The catalogue of what can go wrong in splat rendering, as cases that tests and `fidsplat check` run on a
device (`catalogue.all_cases`)."""
