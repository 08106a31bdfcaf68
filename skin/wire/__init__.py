"""Read a skin at a port: protocol, decoder, reader, tare, conversion to newtons, segmentation."""
