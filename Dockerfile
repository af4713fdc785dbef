FROM python:3.12-slim
RUN apt-get update && apt-get install --yes --no-install-recommends binutils
WORKDIR /clpipe
COPY . .
CMD ["sh", "tools/demo", "/demo"]
