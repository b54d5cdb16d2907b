"""Tables of a job: columns of numbers, and facts in JSON, in a folder or under a URL."""
