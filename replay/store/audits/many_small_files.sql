-- severity: info
-- advice: `restock store compact STORE` joins them, also while ingest runs; every scan then opens fewer files.
-- doc: A store with so many files of so few rows that opening the files takes longer than reading the rows.
SELECT count(DISTINCT file) AS files, sum(rows) AS rows, sum(rows) / count(DISTINCT file) AS rows_a_file
FROM stored_ingests
HAVING files >= $min_files AND rows_a_file < $max_rows_a_file
