"""Tables of a job: columns of numbers and facts, in a folder or under a URL."""
