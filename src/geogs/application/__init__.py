"""The program without a command line: run, reconstruct, write results, go on."""
