# smartnav as a container: docker build -t smartnav . && docker run --rm -v "$PWD:/data" smartnav smooth log.zip --out run
FROM python:3.12-slim AS build
WORKDIR /source
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY smartnav_graph smartnav_graph
RUN python -m venv /opt/smartnav \
 && /opt/smartnav/bin/pip install --no-cache-dir -c constraints.txt .

FROM python:3.12-slim
COPY --from=build /opt/smartnav /opt/smartnav
ENV PATH=/opt/smartnav/bin:$PATH OMP_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE=1
RUN useradd --create-home smartnav && mkdir /data && chown smartnav /data
USER smartnav
WORKDIR /data
ENTRYPOINT ["smartnav"]
CMD ["--help"]
