"""The functions of the public API, which `copem_replay` exports beside the types; the commands call them, too."""
