"""The load-encoder watch: does the model still hold?"""
