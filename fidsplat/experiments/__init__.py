"""One module for each thing that is shown or measured with the whole program: the demo, tables, figures."""
