"""An experiment drafted from a recording."""
