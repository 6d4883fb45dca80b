"""Readers of map formats: each fills a `SiteMap` (docs/guide/place.md)."""
