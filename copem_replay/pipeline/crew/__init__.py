"""The crew: workers of one machine or of many that compute the pieces of a study (docs/guide/scale.md)."""
