"""When the receiver first knows of an object."""
