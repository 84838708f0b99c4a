"""What tests build with: recordings, stores, runs, a small twin, an S3 server."""
