"""What a program tells who watches it: figures for Prometheus, whether it lives and is ready, and why not."""
