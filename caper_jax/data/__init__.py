"""What comes from outside: images, clouds, streams, files and data sets."""
