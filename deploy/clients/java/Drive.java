import java.net.URI;
import java.net.http.HttpClient;
import java.net.http.WebSocket;
import java.util.Locale;
import java.util.concurrent.CompletionException;
import java.util.concurrent.CompletionStage;
import java.util.regex.Matcher;
import java.util.regex.Pattern;

/** Drives the robot forward for two seconds and prints where it is: `java Drive.java [ADDRESS [TOKEN]]`. */
public class Drive implements WebSocket.Listener {
    private static final int PERIOD_MS = 50;

    // Java has no JSON parser. A program that reads more than these numbers should use a JSON library.
    private static final String NUMBER = "(-?[0-9.eE+-]+)";
    private static final Pattern ODOMETRY = Pattern.compile(
        "\"key\":\"odom\".*?\"position\":\\{\"x\":" + NUMBER + ",\"y\":" + NUMBER
        + ".*\"linear\":\\{\"x\":" + NUMBER);

    private static final Pattern BEAT = Pattern.compile("\"key\":\"beat\",\"value\":(\\{[^}]*\\})");

    // The newest beat of the robot, by which it knows how old a command is.
    private static volatile String beat = null;

    private final StringBuilder text = new StringBuilder();

    @Override
    public CompletionStage<?> onText(WebSocket socket, CharSequence part, boolean last) {
        text.append(part);
        if (last) {
            Matcher beats = BEAT.matcher(text);
            Matcher found = ODOMETRY.matcher(text);
            if (beats.find()) {
                beat = beats.group(1);
            } else if (found.find()) {
                // One println writes the whole line, even if the program ends at this moment.
                System.out.println(String.format(Locale.ROOT, "x %.3f m, y %.3f m, %.3f m/s",
                    Double.valueOf(found.group(1)), Double.valueOf(found.group(2)),
                    Double.valueOf(found.group(3))));
            } else if (text.indexOf("\"refused\"") >= 0) {
                System.err.println(text);
            }
            text.setLength(0);
        }
        socket.request(1);
        return null;
    }

    private static void drive(WebSocket socket, double speed, double seconds) throws InterruptedException {
        for (int sent = 0; sent < seconds * 1000 / PERIOD_MS; sent++) {
            String command = String.format(Locale.ROOT,
                "{\"cmd\": {\"linear_x\": %f, \"angular_z\": 0}, \"echo\": %s}", speed, beat);
            socket.sendText(command, true).join();
            Thread.sleep(PERIOD_MS);
        }
    }

    public static void main(String[] arguments) throws InterruptedException {
        String address = arguments.length > 0 ? arguments[0] : "http://127.0.0.1:8080";
        WebSocket.Builder builder = HttpClient.newHttpClient().newWebSocketBuilder();
        if (arguments.length > 1) {
            builder.header("Authorization", "Bearer " + arguments[1]);
        }
        URI place = URI.create(address.replaceFirst("http", "ws").replaceFirst("/$", "") + "/ws");
        WebSocket socket;
        try {
            socket = builder.buildAsync(place, new Drive()).join();
        } catch (CompletionException error) {
            System.err.println("no connection to " + address + ": " + error.getCause());
            System.exit(1);
            return;
        }
        socket.sendText("{\"subscribe\": \"beat\"}", true).join();
        socket.sendText("{\"subscribe\": \"odom\", \"rate\": 10}", true).join();
        while (beat == null) {
            Thread.sleep(10);
        }
        drive(socket, 0.0, 0.1); // a zero arms this sender
        drive(socket, 0.2, 2.0);
        drive(socket, 0.0, 1.0);
        socket.sendClose(WebSocket.NORMAL_CLOSURE, "").join();
    }
}
