"""Parts of the benchmark of versions of datasets; `benchmarks.bench_datasets` runs them."""
