"""The floors that robots drive on (generated, or from files and maps), and plans on them."""
