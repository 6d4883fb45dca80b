"""What tests of several wings use: scenes, recordings, experiments made by hand."""
