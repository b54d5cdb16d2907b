"""The methods: one stage a module, called by `nanogs.pipeline`; the paper's are in `paper`."""
