"""Messages of any schema, taken apart into columns: CDR, protobuf, JSON."""
