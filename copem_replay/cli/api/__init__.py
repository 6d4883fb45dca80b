"""The public API: what `copem_replay` exports beside the types. The commands are built of the same functions."""
