"""What instruments sent, recorded as they sent it: read by the decoders that listen to them."""
