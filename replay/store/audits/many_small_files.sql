-- severity: info
-- advice: `restock compact STORE` joins them, also while ingest goes on; every scan then opens fewer.
-- doc: A store of so many files of so few rows that opening them takes longer than reading their rows.
SELECT count(DISTINCT file) AS files, sum(rows) AS rows, sum(rows) / count(DISTINCT file) AS rows_a_file
FROM stored_ingests
HAVING files >= $min_files AND rows_a_file < $max_rows_a_file
