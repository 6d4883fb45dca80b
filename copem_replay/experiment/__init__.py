"""The experiment file: schema, problems with file and line, drafts from a recording."""
