"""What `fidsplat bench` and `fidsplat warm` do: scenes to draw, the loop that times them, and the model of
what a frame must cost."""
