"""The paper's figures, made of results: each with what the paper says and what came out."""
