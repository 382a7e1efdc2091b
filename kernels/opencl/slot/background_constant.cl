// One colour behind everything: the background that resolving is given.
