"""Work that is done by processes on other machines."""
